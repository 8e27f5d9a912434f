"""A triangulator that takes the point nearest to the rays of all cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, nearest_point, propagate, usable_pairs
from measure.host import Settings, Triangulator, hookimpl, setting
from measure.model import BallPosition, Camera, Detection


class NearestSettings(Settings):
    """Settings of the `nearest` triangulator."""

    min_angle_deg: float = setting(
        2.0, "Rays that all meet at smaller angles give no position.", unit="deg", gt=0, lt=90
    )


class NearestTriangulator(Triangulator):
    """The point with the least sum of squared distances from the rays."""

    name = "nearest"
    Config = NearestSettings
    config: NearestSettings

    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball; the cameras' calibration counts as exact."""
        if len(detections) < 2:
            return None
        used = [cameras[detection.camera] for detection in detections]
        pixels = np.stack([detection.center_px for detection in detections])
        rays = _rays(used, pixels)
        try:
            usable_pairs(rays, float(np.radians(self.config.min_angle_deg)))
        except DegenerateGeometryError:  # there is no such pair
            return None
        center = nearest_point(rays)
        noise = np.stack([detection.covariance_px for detection in detections])
        return BallPosition(
            ball=detections[0].ball,
            time_s=float(np.mean([detection.time_s for detection in detections])),
            center=center,
            covariance=propagate(_sensitivity(used, pixels), noise).sum(axis=0),
            cameras=tuple(camera.name for camera in used),
            residuals_mm=rays.distances(center),
        )


def _rays(cameras: Sequence[Camera], pixels: Floats) -> Rays:
    """The world ray of one pixel (n, 2) of each of n cameras."""
    single = [camera.rays(pixel[None]) for camera, pixel in zip(cameras, pixels, strict=True)]
    return Rays(
        np.concatenate([ray.origins for ray in single]),
        np.concatenate([ray.directions for ray in single]),
    )


def _sensitivity(cameras: Sequence[Camera], pixels: Floats) -> Floats:
    """Derivatives (n, 3, 2) of the point by the pixels (n, 2), in mm per px."""
    by_pixel = np.empty((len(pixels), 3, 2))
    for camera, axis in np.ndindex(pixels.shape):
        step = np.zeros_like(pixels)
        step[camera, axis] = 0.5
        ahead, back = (nearest_point(_rays(cameras, pixels + d)) for d in (step, -step))
        by_pixel[camera, :, axis] = ahead - back
    return by_pixel


@hookimpl
def measure_triangulators() -> list[type[Triangulator]]:
    """Register `nearest`."""
    return [NearestTriangulator]
