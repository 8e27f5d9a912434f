"""`dlt`: the textbook's linear triangulation, kept as a reference to compare with.

Each pixel gives two equations linear in the homogeneous point (Hartley and Zisserman 2004, section
12.2); here in undistorted coordinates, scaled by the focal length so that residuals are in px. It
minimises an algebraic error, weights all cameras alike and drops none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation import PointObservations, ray_distances
from measure.geometry import propagate
from measure.geometry.rays import MIN_PARALLAX_RAD
from measure.host import Settings, Triangulator, hookimpl
from measure.model import BallPosition, Camera, Detection


class DltTriangulator(Triangulator):
    """Linear least squares on the homogeneous point."""

    name = "dlt"
    Config = Settings

    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball; None for fewer than two cameras or parallel rays."""
        if len(detections) < 2:
            return None
        observations = PointObservations.of(detections, cameras)
        point = _linear_point(observations)
        if point is None:
            return None
        residuals, by_point = observations.residuals(point)
        if not np.all(np.isfinite(residuals)):
            return None
        noise = observations.total_noise(point)
        by_pixel = np.linalg.inv(by_point.reshape(-1, 3).T @ by_point.reshape(-1, 3)) @ np.swapaxes(
            by_point, 1, 2
        )
        covariance = propagate(by_pixel, noise).sum(axis=0)
        return BallPosition(
            ball=detections[0].ball,
            time_s=float(np.mean([d.time_s for d in detections])),
            center=point,
            covariance=covariance,
            cameras=observations.rig.names,
            residuals_mm=ray_distances(observations, point),
        )


def _linear_point(observations: PointObservations) -> Floats | None:
    """The point (3,) in mm that solves the stacked equations, or None for parallel rays."""
    rig, rays = observations.rig, observations.rig.rays(observations.pixels)
    # Everything in units of the distance to the cameras' centroid: an even spread of magnitudes.
    origin = rig.centers.mean(axis=0)
    scale = float(np.max(np.linalg.norm(rig.centers - origin, axis=1))) or 1.0
    local = np.einsum("nji,nj->ni", rig.rows.rotation, rays.directions)
    bearings = local[:, :2] / local[:, 2:]
    axes = np.swapaxes(rig.rows.rotation, 1, 2)
    moved = -np.einsum("nij,nj->ni", axes, (rig.centers - origin) / scale)
    rows = np.concatenate([axes, moved[:, :, None]], axis=2)
    design = bearings[:, :, None] * rows[:, 2:, :] - rows[:, :2, :]
    _, s, vt = np.linalg.svd(design.reshape(-1, 4))
    if not s[2] > MIN_PARALLAX_RAD * s[0] or abs(vt[3, 3]) < MIN_PARALLAX_RAD:
        return None
    return origin + scale * vt[3, :3] / vt[3, 3]


@hookimpl
def measure_triangulators() -> list[type[Triangulator]]:
    """Register `dlt`."""
    return [DltTriangulator]
