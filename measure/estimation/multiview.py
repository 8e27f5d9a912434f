"""One ball centre seen by several cameras: least squares on the reprojection error.

Each camera contributes its pixel with a 2x2 covariance: the detection's, plus what an uncertain
camera pose and lens add (Hartley and Zisserman 2004, sections 5.2 and 12.5). One observation per
camera and cameras calibrated independently make that sum the exact weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.model import Camera, Detection, Rig
from measure.model.observations import stacked_detections

if TYPE_CHECKING:
    from measure.estimation.point_fit import PointFit


@dataclass(frozen=True, eq=False, slots=True)
class PointObservations:
    """The pixels of one ball centre in n cameras."""

    rig: Rig  # the n cameras
    pixels: Floats  # (n, 2)
    noise: Floats  # (n, 2, 2) covariances of the pixels alone, px^2
    # (n, 3) where each camera saw the point, relative to where it is at the common instant, mm,
    # world: zero for simultaneous pictures.
    shifts: Floats

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        shifts: Floats | None = None,
    ) -> PointObservations:
        """Stack the detections of one ball, in their order.

        Args:
            detections: n >= 1 of them, one for each camera.
            cameras: by name.
            shifts: (n, 3) see above; zero if omitted.
        """
        return cls(
            Rig.of([cameras[d.camera] for d in detections]),
            *stacked_detections(tuple(detections)),
            np.zeros((len(detections), 3)) if shifts is None else shifts,
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: list[int]) -> PointObservations:
        """Only some of the observations."""
        return PointObservations(
            self.rig.take(rows), self.pixels[rows], self.noise[rows], self.shifts[rows]
        )

    def residuals(self, point: Floats) -> tuple[Floats, Floats]:
        """Measured minus predicted pixels (n, 2), and the Jacobians (n, 2, 3) of the predicted.

        By the point (3,), mm, world; NaN for a camera behind which it lies.
        """
        predicted, by_point = self.rig.project(point + self.shifts)
        return self.pixels - predicted, by_point

    def by_camera(self, point: Floats) -> Floats:
        """Jacobians (n, 2, 18) of the pixels by the cameras' poses and intrinsics."""
        from measure.model.projection import by_cameras

        return by_cameras(self.rig.rows, point + self.shifts)

    def total_noise(self, point: Floats) -> Floats:
        """Covariances (n, 2, 2) of the residuals at `point` (3,), calibration included, px^2."""
        return self.noise + calibration_noise(self.rig, point + self.shifts)


def calibration_noise(rig: Rig, points: Floats) -> Floats:
    """What uncertain cameras add to the covariances (n, 2, 2) of the pixels of points, px^2.

    See docs/explanation/joint_fit.md, formula 7.

    Zero for points without an image: a camera may show a ball of a body, and not its middle.

    Args:
        rig: n cameras.
        points: (n, 3) in mm, one for each camera, or one point (3,) for all.
    """
    from measure.model.projection import camera_noise

    if not rig.uncertain:
        return np.zeros((len(rig), 2, 2))
    places = np.broadcast_to(points, rig.centers.shape)
    noise = camera_noise(rig.rows, np.ascontiguousarray(places))
    return np.nan_to_num(noise, nan=0.0)


def fit_point(observations: PointObservations, extra_px: float = 0.0) -> PointFit:
    """Gauss-Newton on the reprojection error of n >= 2 pixels, weighted by full covariances.

    See docs/explanation/joint_fit.md, formula 21.

    Args:
        extra_px: added to every pixel's standard deviation in quadrature, for `disagreement` alone.

    Raises:
        DegenerateGeometryError: fewer than two pixels, parallel rays, or the point is not in front
            of every camera.
    """
    from measure.estimation.point_fit import FITTED, PARALLEL, fit_point_rows

    o = observations
    if len(o) < 2:
        raise DegenerateGeometryError(f"{len(o)} view does not determine a point")
    fit = fit_point_rows(o.rig.rows, o.pixels, o.noise, o.shifts, extra_px)
    if fit.end != FITTED:
        what = "are parallel" if fit.end == PARALLEL else "meet behind a camera"
        raise DegenerateGeometryError(f"the rays of {', '.join(o.rig.names)} {what}")
    return fit


def ray_distances(observations: PointObservations, point: Floats) -> Floats:
    """Distances (n,) in mm of the pixels' rays from `point` (3,)."""
    return observations.rig.rays(observations.pixels).distances(point + observations.shifts)


def point_sensitivity(observations: PointObservations, point: Floats) -> tuple[Floats, Floats]:
    """How a fitted point reacts to its inputs: the derivatives of the least-squares solution.

    Returns:
        By the pixels (n, 3, 2), mm per px, and by the cameras' poses and intrinsics (n, 3, 18): if
        camera i is truly off by d, the fitted point errs by `by_camera[i] @ d`.
    """
    weight = np.linalg.inv(observations.total_noise(point))
    by_point = observations.residuals(point)[1]
    weighted = np.swapaxes(by_point, 1, 2) @ weight
    by_pixel = np.linalg.inv((weighted @ by_point).sum(axis=0)) @ weighted
    return by_pixel, by_pixel @ observations.by_camera(point)
