"""`reprojection`: covariance-weighted least squares on the pixels of all cameras, robust.

The maximum-likelihood estimate for Gaussian pixels (Hartley and Sturm 1997; Hartley and Zisserman
2004, section 12.5). A camera that disagrees with the others is left out, by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.estimation import PointObservations, fit_point
from measure.geometry import chi_square_quantile
from measure.host import Settings, Triangulator, hookimpl, setting
from measure.model import BallPosition, Camera, Detection, Rig
from measure.model.observations import stacked_detections

if TYPE_CHECKING:
    from measure.estimation import PointFit


_SCATTER = 0.99


class ReprojectionConfig(Settings):
    """Settings of the `reprojection` triangulator."""

    confidence: float = setting(
        0.999,
        "Residuals that the detections' covariances make rarer than this leave a camera out.",
        gt=0.5,
        lt=1,
    )
    tolerance_px: float = setting(
        0.5,
        "Disagreement always tolerated, added to every detection's standard deviation before a "
        "camera is dropped; it does not enter the weights.",
        unit="px",
        ge=0,
    )
    max_dropped: int = setting(2, "Most cameras to leave out of one position.", ge=0)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fit on some of the views, and how far beyond the gate its residuals are (<= 1: inside)."""

    rows: list[int]
    fit: PointFit
    excess: float


class ReprojectionTriangulator(Triangulator):
    """Covariance-weighted N-view least squares that names the camera it drops."""

    name = "reprojection"
    Config = ReprojectionConfig
    config: ReprojectionConfig

    def warm_up(self) -> None:
        """Compile the fit (seconds, once per machine), by fitting a point to nothing."""
        from measure.estimation import warm_up_point_fits

        warm_up_point_fits()

    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball; None for fewer than two cameras or parallel rays."""
        if len(detections) < 2:
            return None
        views = PointObservations.of(detections, cameras)
        chosen, rivals = self._choose(views)
        if chosen is None:
            return None
        used = [detections[row] for row in chosen.rows]
        return BallPosition(
            ball=detections[0].ball,
            time_s=sum(d.time_s for d in used) / len(used),
            center=chosen.fit.point,
            covariance=_honest_covariance(chosen, rivals),
            cameras=tuple(d.camera for d in used),
            residuals_mm=chosen.fit.distances_mm,
            dropped=tuple(n for i, n in enumerate(views.rig.names) if i not in chosen.rows),
        )

    def triangulate_all(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> list[BallPosition]:
        """Locate all balls at once; those on which the cameras do not agree, one by one."""
        from measure.estimation import fit_points

        seen = _grouped(
            tuple([d.ball for d in detections]), tuple([cameras[d.camera] for d in detections])
        )
        if not seen.groups:
            return []
        rig, used = seen.rig, [detections[row] for row in seen.rows.tolist()]
        pixels, noise = stacked_detections(tuple(detections))
        fits = fit_points(
            seen.starts, rig.rows, pixels[seen.rows], noise[seen.rows], self.config.tolerance_px
        )
        fitted, apart = fits.fitted.tolist(), fits.disagreements.tolist()
        chi_squares, out = fits.chi_squares.tolist(), list[BallPosition | None]()
        for i, (first, last) in enumerate(seen.groups):
            own, degrees = used[first:last], 2 * (last - first) - 3
            agreed = fitted[i] and self._agreed(apart[i], chi_squares[i], degrees)
            if not agreed:
                out.append(self.triangulate(own, cameras))
                continue
            names, distances = rig.names[first:last], fits.distances_mm[first:last]
            time_s = sum(d.time_s for d in own) / len(own)
            out.append(
                BallPosition(
                    own[0].ball, time_s, fits.points[i], fits.covariances[i], names, distances
                )
            )
        return [position for position in out if position is not None]

    def _agreed(self, disagreement: float, chi_square: float, degrees: int) -> bool:
        """Whether no camera would be left out, and the covariance stays as it is."""
        gate = chi_square_quantile(self.config.confidence, degrees)
        return disagreement <= gate and chi_square <= chi_square_quantile(_SCATTER, degrees)

    def _choose(self, views: PointObservations) -> tuple[_Candidate | None, list[_Candidate]]:
        """The fit to use, and the other fits that leave as many cameras out and pass the gate."""
        best = self._try(views, list(range(len(views))))
        rivals: list[_Candidate] = []
        for _ in range(min(self.config.max_dropped, len(views) - 2)):
            if best is not None and best.excess <= 1:
                break
            rows = best.rows if best is not None else list(range(len(views)))
            tried = [self._try(views, [r for r in rows if r != out]) for out in rows]
            ranked = sorted((c for c in tried if c is not None), key=lambda c: c.excess)
            if not ranked or (best is not None and ranked[0].excess >= best.excess):
                break
            best, *others = ranked
            rivals = [c for c in others if c.excess <= 1]
        return best, rivals

    def _try(self, views: PointObservations, rows: list[int]) -> _Candidate | None:
        some = views if len(rows) == len(views) else views.take(rows)
        try:
            fit = fit_point(some, self.config.tolerance_px)
        except DegenerateGeometryError:
            return None
        gate = chi_square_quantile(self.config.confidence, 2 * len(rows) - 3)
        return _Candidate(rows, fit, float(fit.disagreement.sum()) / gate)


@dataclass(frozen=True, eq=False)
class _Grouped:
    """Which of some detections show the same ball: balls in the order in which they first come."""

    rows: Ints  # (n,) the detections of balls that two or more show, ball by ball
    groups: tuple[tuple[int, int], ...]  # (k,) first and last but one of each ball's, in `rows`
    starts: Ints  # (k + 1,) the same
    rig: Rig  # (n,) the detections' cameras


@lru_cache(maxsize=64)
def _grouped(balls: tuple[str, ...], cameras: tuple[Camera, ...]) -> _Grouped:
    """Cameras compare by identity: what is kept never stands for a camera that was changed."""
    rows = [[i for i, name in enumerate(balls) if name == ball] for ball in dict.fromkeys(balls)]
    rows = [some for some in rows if len(some) > 1]
    starts, flat = [0, *accumulate(map(len, rows))], [i for some in rows for i in some]
    rig = Rig.of([cameras[i] for i in flat])
    return _Grouped(np.array(flat), tuple(pairwise(starts)), np.array(starts), rig)


def _honest_covariance(chosen: _Candidate, rivals: Sequence[_Candidate]) -> Floats:
    """The fit's covariance; wider where the cameras disagree or another choice is as good.

    Beyond the quantile `_SCATTER` the covariance grows with the residuals (Birge ratio). If leaving
    out a different camera passes as well, nobody can tell which one errs: the distance between the
    two answers becomes part of the uncertainty.
    """
    fit = chosen.fit
    degrees = 2 * len(chosen.rows) - 3
    covariance = fit.covariance
    if fit.chi_square > chi_square_quantile(_SCATTER, degrees):
        covariance = covariance * (fit.chi_square / degrees)
    for rival in rivals:
        apart = rival.fit.point - fit.point
        covariance = covariance + np.outer(apart, apart)
    return covariance


@hookimpl
def measure_triangulators() -> list[type[Triangulator]]:
    """Register `reprojection`."""
    return [ReprojectionTriangulator]
