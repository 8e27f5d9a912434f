"""The paper's triangulation: midpoints of common perpendiculars, averaged over pairs of rays.

Peng, Yang, Su, Hannaford (ICRA 2020), section II.D: "the midpoint of the common perpendicular of
the two rays is selected to be the intersection point. When the number of effective circles is
larger than 2, the mean position is taken from each pair of rays."
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, midpoints, propagate, usable_pairs
from measure.host import Settings, Triangulator, hookimpl, setting
from measure.model import Camera, Detection, Fix

_STEP_PX = 0.25
"""Half the step of the central differences; the midpoint is smooth over many pixels."""


class MidpointSettings(Settings):
    """Settings of `midpoint`."""

    min_angle_deg: float = setting(
        5.0, "pairs of rays that meet at a smaller angle are left out", unit="deg", gt=0, lt=90
    )


class MidpointTriangulator(Triangulator):
    """Mean over all pairs of rays of the midpoint of their common perpendicular."""

    name = "midpoint"
    Config = MidpointSettings
    config: MidpointSettings

    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> Fix | None:
        """Locate one ball from two or more cameras; see `Triangulator.triangulate`.

        The covariance holds what the detections' covariances and, where they are known, those of
        the camera poses do to the mean of the midpoints.
        """
        seen = [d for d in detections if np.all(np.isfinite(_ray(d, cameras).directions))]
        if len(seen) < 2:
            return None
        rays = _stack([_ray(d, cameras) for d in seen])
        try:
            pairs = usable_pairs(rays, np.radians(self.config.min_angle_deg))
        except DegenerateGeometryError:
            return None
        center = midpoints(rays.origins, rays.directions, pairs).mean
        used = sorted(set(pairs.ravel().tolist()))
        ahead = np.sum((center - rays.origins) * rays.directions, axis=1)
        if np.any(ahead[used] <= 0):
            return None
        return Fix(
            ball=seen[0].ball,
            time_s=float(np.mean([seen[row].time_s for row in used])),
            center=center,
            covariance=_covariance([cameras[d.camera] for d in seen], seen, rays, pairs),
            cameras=tuple(seen[row].camera for row in used),
            residuals_mm=rays.distances(center)[used],
            dropped=tuple(d.camera for row, d in enumerate(seen) if row not in used),
        )


@hookimpl
def measure_triangulators() -> list[type[Triangulator]]:
    """Register the triangulator."""
    return [MidpointTriangulator]


def _ray(detection: Detection, cameras: Mapping[str, Camera]) -> Rays:
    return cameras[detection.camera].rays(detection.center_px[None])


def _stack(rays: Sequence[Rays]) -> Rays:
    return Rays(
        np.concatenate([ray.origins for ray in rays]),
        np.concatenate([ray.directions for ray in rays]),
    )


def _covariance(
    cameras: Sequence[Camera], seen: Sequence[Detection], rays: Rays, pairs: Ints
) -> Floats:
    """(3, 3) in mm^2, to first order, by central differences of the mean of midpoints."""
    total = np.zeros((3, 3))
    for row, (camera, detection) in enumerate(zip(cameras, seen, strict=True)):
        shifts = _STEP_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        moved = camera.rays(detection.center_px + shifts)
        by_pixel = _differences(rays, row, moved, pairs) / (2 * _STEP_PX)
        total += propagate(by_pixel, detection.covariance_px)
        if camera.pose_covariance is not None:
            step = 1e-3
            by_pose = _differences(rays, row, _perturbed(rays, row, step), pairs) / (2 * step)
            total += propagate(by_pose, camera.pose_covariance)
    return total


def _differences(rays: Rays, row: int, moved: Rays, pairs: Ints) -> Floats:
    """Columns (3, m): the mean with ray `row` as `moved[2 j]` less that with `moved[2 j + 1]`."""
    count = len(moved.directions)
    origins = np.repeat(rays.origins[None], count, axis=0)
    directions = np.repeat(rays.directions[None], count, axis=0)
    origins[:, row], directions[:, row] = moved.origins, moved.directions
    means = midpoints(origins, directions, pairs).mean
    return np.asarray((means[0::2] - means[1::2]).T)


def _perturbed(rays: Rays, row: int, step: float) -> Rays:
    """Ray `row` with its camera moved by plus and minus `step` (mm, rad) along each of six axes."""
    origin, direction = rays.origins[row], rays.directions[row]
    signed = np.stack([np.eye(3) * step, -np.eye(3) * step], axis=1).reshape(6, 3)
    still = np.repeat(direction[None], 6, axis=0)
    origins = np.concatenate([origin + signed, np.repeat(origin[None], 6, axis=0)])
    return Rays(origins, np.concatenate([still, still + np.cross(signed, direction)]))
