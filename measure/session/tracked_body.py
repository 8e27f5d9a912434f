"""A rigid body in a table of poses that another program wrote."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import MeasureError

FARTHEST_MM = 1e6  # No camera or body is farther away: NDI writes -3.7e28 for what is not known


@dataclass(frozen=True)
class TrackedBody:
    """Where a rigid body stands in a table."""

    rows: Sequence[Sequence[str]]  # cells of the file; a row without cells is passed over
    after: int  # the index of the last row of headings
    times: list[int]  # columns of the time, and
    units_s: list[float]  # their units in s
    turns: list[int]  # columns of the rotation
    # makes quaternions (n, 4) of them; zeros of zeros, NaN of what is no rotation.
    quat_wxyz: Callable[[Floats], Floats]
    places: list[int]  # first column of x y z
    unit_mm: float = 1.0  # of these
    begin_s: float = 0.0  # the time that counts as 0

    def read(self, path: Path, error: type[MeasureError]) -> tuple[Floats, list[int]]:
        """Rows (n, 8) of time in s, position in mm, quaternion w x y z; and their lines.

        Rows in which a cell is empty are passed over: the body was not seen.
        `error`: a cell is no number.
        """
        out, lines = [], list[int]()
        columns = [*self.times, *self.places, *self.turns]
        for index, row in enumerate(self.rows[self.after + 1 :], start=self.after + 2):
            cells = [row[c].strip() if c < len(row) else "" for c in columns]
            if all(cells):
                try:
                    out.append([float(cell) for cell in cells])
                except ValueError:
                    raise error(f"{path}:{index}: not numbers: {','.join(cells)[:60]}") from None
                lines.append(index)
        values, t = np.array(out).reshape(-1, len(columns)), len(self.times)
        times = (values[:, :t] @ self.units_s)[:, None] - self.begin_s
        turned = self.quat_wxyz(values[:, t + 3 :]).reshape(-1, 4)
        return np.concatenate([times, self.unit_mm * values[:, t : t + 3], turned], axis=1), lines
