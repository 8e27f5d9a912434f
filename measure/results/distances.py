"""The body measured with itself: its balls' distances against the body file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.results.run import Run

SURE = 3.0
"""A difference of more standard errors than this is no chance."""
LEAST_SETS = 5
"""Of fewer frame sets the standard error is not known well enough to say so."""


@dataclass(frozen=True, eq=False)
class BallDistance:
    """One pair of balls over a run.

    Attributes:
        balls: their names.
        nominal_mm: by the body file.
        measured_mm: (n,) in every frame set; NaN where one of them has no fix.
    """

    balls: tuple[str, str]
    nominal_mm: float
    measured_mm: Floats

    @property
    def count(self) -> int:
        """In how many frame sets both have a fix."""
        return int(np.count_nonzero(np.isfinite(self.measured_mm)))

    @property
    def mean_mm(self) -> float:
        """NaN without a frame set."""
        return float(np.nanmean(self.measured_mm)) if self.count else np.nan

    @property
    def off_mm(self) -> float:
        """Mean measured minus nominal."""
        return self.mean_mm - self.nominal_mm

    @property
    def standard_error_mm(self) -> float:
        """Of the mean."""
        if not self.count:
            return np.nan
        return float(np.nanstd(self.measured_mm) / np.sqrt(self.count))

    @property
    def significant(self) -> bool:
        """Whether the difference is more than chance."""
        return self.count >= LEAST_SETS and abs(self.off_mm) > SURE * self.standard_error_mm


def ball_distances(run: Run) -> list[BallDistance]:
    """Every pair of balls of the run's body."""
    at = {name: np.full((run.poses.num_rows, 3), np.nan) for name in run.body.names}
    place = np.column_stack([run.balls[name].to_numpy() for name in ("x_mm", "y_mm", "z_mm")])
    rows = {index: row for row, index in enumerate(run.poses["index"].to_pylist())}
    for ball, index, center in zip(
        run.balls["ball"].to_pylist(), run.balls["index"].to_pylist(), place, strict=True
    ):
        at[ball][rows[index]] = center
    return [
        BallDistance(pair, nominal, np.linalg.norm(at[pair[0]] - at[pair[1]], axis=1))
        for pair, nominal in run.body.distances().items()
    ]
