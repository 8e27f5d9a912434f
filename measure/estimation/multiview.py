"""One point seen by several cameras: least squares on the reprojection, and its sensitivities.

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
class Views:
    """One ball's pixels in n cameras.

    Attributes:
        cameras: the n cameras.
        rig: the same, stacked.
        pixels: (n, 2).
        noise: (n, 2, 2) covariances of the pixels alone.
        shifts: (n, 3) where each camera saw the point, relative to where it is at the common
            instant, mm: zero for simultaneous pictures.
    """

    cameras: tuple[Camera, ...]
    rig: Rig
    pixels: Floats
    noise: Floats
    shifts: Floats

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        shifts: Floats | None = None,
    ) -> Views:
        """Stack `detections` of one ball."""
        used = tuple(cameras[d.camera] for d in detections)
        return cls(
            used,
            Rig.of(used),
            *stacked_detections(tuple(detections)),
            np.zeros((len(used), 3)) if shifts is None else shifts,
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: list[int]) -> Views:
        """Only some of the views."""
        return Views(
            tuple(self.cameras[i] for i in rows),
            self.rig.take(rows),
            self.pixels[rows],
            self.noise[rows],
            self.shifts[rows],
        )

    def sensitivity(self, point: Floats) -> tuple[Floats, Floats, Floats]:
        """Residuals (n, 2), Jacobians by the point (n, 2, 3) and by the camera poses (n, 2, 6)."""
        from measure.estimation.pixel_sensitivity import sensitivities

        predicted, by_point, by_pose = sensitivities(self.rig.rows, point + self.shifts)
        return self.pixels - predicted, by_point, by_pose

    def by_camera(self, point: Floats) -> Floats:
        """Jacobians (n, 2, 18) of the pixels by the cameras' poses and intrinsics.

        Of cameras without a covariance, and of intrinsics without one, they are left at zero.
        """
        from measure.estimation.pixel_sensitivity import by_cameras

        return by_cameras(self.rig.rows, point + self.shifts, self.sensitivity(point)[2])

    def camera_noise(self, point: Floats) -> Floats:
        """What uncertain cameras add to the pixels' covariances (n, 2, 2)."""
        return calibration_noise(self.rig, point + self.shifts)

    def total_noise(self, point: Floats) -> Floats:
        """The pixels' covariances (n, 2, 2), calibration included."""
        return self.noise + self.camera_noise(point)


def calibration_noise(rig: Rig, points: Floats) -> Floats:
    """What uncertain cameras add to the covariances (n, 2, 2) of the pixels of points, px^2.

    Zero for points without an image: a camera may show a ball of a body, and not its middle.

    Args:
        rig: n cameras.
        points: (n, 3) in mm, one for each camera, or one point (3,) for all.
    """
    from measure.estimation.pixel_sensitivity import camera_noise

    if not rig.uncertain:
        return np.zeros((len(rig), 2, 2))
    places = np.broadcast_to(points, rig.centers.shape)
    noise = camera_noise(rig.rows, np.ascontiguousarray(places))
    return np.nan_to_num(noise, nan=0.0)


def fit_point(views: Views, extra_px: float = 0.0) -> PointFit:
    """Gauss-Newton on the reprojection error of n >= 2 views, weighted by full covariances.

    Args:
        views: what was seen.
        extra_px: added to every pixel's standard deviation in quadrature, for `disagreement` alone.

    Raises:
        DegenerateGeometryError: fewer than two views, parallel rays, or the point is not in front
            of every camera.
    """
    from measure.estimation.point_fit import FITTED, PARALLEL, fit_one

    if len(views) < 2:
        raise DegenerateGeometryError(f"{len(views)} view does not determine a point")
    rig = views.rig
    fit = fit_one(rig.rows, views.pixels, views.noise, views.shifts, extra_px)
    if fit.end != FITTED:
        what = "are parallel" if fit.end == PARALLEL else "meet behind a camera"
        raise DegenerateGeometryError(f"the rays of {', '.join(rig.names)} {what}")
    return fit


def ray_distances(views: Views, point: Floats) -> Floats:
    """Distances (n,) in mm of the views' rays from `point`."""
    return views.rig.rays(views.pixels).distances(point + views.shifts)


def leverage(views: Views, point: Floats) -> tuple[Floats, Floats]:
    """How a point fitted to `views` reacts to its inputs.

    Returns:
        By the pixels (n, 3, 2), and by the cameras' poses and intrinsics (n, 3, 18): if camera i is
        truly off by d, the fitted point errs by `by_camera[i] @ d`.
    """
    weight = np.linalg.inv(views.total_noise(point))
    _, by_point, _ = views.sensitivity(point)
    gain = np.swapaxes(by_point, 1, 2) @ weight
    by_pixel = np.linalg.inv((gain @ by_point).sum(axis=0)) @ gain
    return by_pixel, by_pixel @ views.by_camera(point)
