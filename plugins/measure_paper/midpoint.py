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
from measure.geometry import Rays, propagate, usable_pairs
from measure.host import Settings, Triangulator, hookimpl, setting
from measure.model import BallPosition, Camera, Detection, Rig

_STEP_PX = 0.25  # Half the step of the central differences; the midpoint is smooth over many pixels

_STEP_POSE = 1e-3  # The same for a camera's pose, in mm and rad


class MidpointSettings(Settings):
    """Settings of `midpoint`."""

    min_angle_deg: float = setting(
        5.0,
        "Least angle between two rays; pairs that meet at a smaller one are left out.",
        unit="deg",
        gt=0,
        lt=90,
    )


class MidpointTriangulator(Triangulator):
    """Mean over all pairs of rays of the midpoint of their common perpendicular."""

    name = "midpoint"
    Config = MidpointSettings
    config: MidpointSettings

    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball from two or more cameras; see `Triangulator.triangulate`.

        The covariance holds what the detections' covariances and, where they are known, those of
        the camera poses do to the mean of the midpoints.
        """
        if len(detections) < 2:
            return None
        rig = Rig.of([cameras[d.camera] for d in detections])
        rays, moved = _rays(rig, np.stack([d.center_px for d in detections]))
        kept = np.flatnonzero(np.all(np.isfinite(rays.directions), axis=1)).tolist()
        seen = [detections[row] for row in kept]
        rays, moved = Rays(rays.origins[kept], rays.directions[kept]), moved[kept]
        try:
            pairs = usable_pairs(rays, np.radians(self.config.min_angle_deg))
        except DegenerateGeometryError:
            return None
        center = mean_midpoint(rays.origins, rays.directions, pairs)
        used = sorted(set(pairs.ravel().tolist()))
        ahead = np.sum((center - rays.origins) * rays.directions, axis=1)
        if np.any(ahead[used] <= 0):
            return None
        return BallPosition(
            ball=seen[0].ball,
            time_s=float(np.mean([seen[row].time_s for row in used])),
            center=center,
            covariance=_covariance([cameras[d.camera] for d in seen], seen, rays, moved, pairs),
            cameras=tuple(seen[row].camera for row in used),
            residuals_mm=rays.distances(center)[used],
            dropped=tuple(d.camera for row, d in enumerate(seen) if row not in used),
        )


@hookimpl
def measure_triangulators() -> list[type[Triangulator]]:
    """Register the triangulator."""
    return [MidpointTriangulator]


def mean_midpoint(origins: Floats, directions: Floats, pairs: Ints) -> Floats:
    """The mean (..., 3) in mm of the midpoints of the common perpendiculars of chosen pairs.

    Args:
        origins: (..., n, 3) in mm.
        directions: (..., n, 3) unit vectors.
        pairs: (p, 2) rows; no pair may be parallel.
    """
    first, second = pairs[:, 0], pairs[:, 1]
    d1, d2 = directions[..., first, :], directions[..., second, :]
    between = origins[..., second, :] - origins[..., first, :]
    normal = np.cross(d1, d2)
    sine2 = np.sum(normal * normal, axis=-1)
    along1 = np.sum(np.cross(between, d2) * normal, axis=-1) / sine2
    along2 = np.sum(np.cross(between, d1) * normal, axis=-1) / sine2
    foot1 = origins[..., first, :] + along1[..., None] * d1
    foot2 = origins[..., second, :] + along2[..., None] * d2
    return np.asarray(((foot1 + foot2) / 2).mean(axis=-2))


def _rays(rig: Rig, pixels: Floats) -> tuple[Rays, Floats]:
    """Rays of pixels (n, 2), and directions (n, 4, 3) with each pixel moved by +x, -x, +y, -y."""
    count = len(pixels)
    shifts = _STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    rows = np.repeat(np.arange(count), len(shifts))
    rays = rig.take(rows).rays((pixels[:, None] + shifts).reshape(-1, 2))
    origins = rays.origins.reshape(count, len(shifts), 3)
    directions = rays.directions.reshape(count, len(shifts), 3)
    return Rays(origins[:, 0], directions[:, 0]), directions[:, 1:]


def _covariance(
    cameras: Sequence[Camera], seen: Sequence[Detection], rays: Rays, moved: Floats, pairs: Ints
) -> Floats:
    """(3, 3) in mm^2, to first order, by central differences of the mean of midpoints."""
    by_pixel = _differences(rays, rays.origins[:, None].repeat(4, axis=1), moved, pairs)
    noise = np.stack([detection.covariance_px for detection in seen])
    total = propagate(by_pixel / (2 * _STEP_PX), noise).sum(axis=0)
    if any(camera.pose_covariance is not None for camera in cameras):
        by_pose = _differences(rays, *_perturbed(rays), pairs) / (2 * _STEP_POSE)
        known = [c.pose_covariance for c in cameras]
        poses = np.stack([np.zeros((6, 6)) if c is None else c for c in known])
        total = total + propagate(by_pose, poses).sum(axis=0)
    return np.asarray(total)


def _differences(rays: Rays, origins: Floats, directions: Floats, pairs: Ints) -> Floats:
    """How the mean of midpoints moves, (n, 3, m), when one ray at a time is replaced.

    Args:
        rays: n of them.
        origins: (n, 2 m, 3) of the replacements of each ray, in pairs: the second is subtracted.
        directions: (n, 2 m, 3) of the same.
        pairs: (p, 2) as in `mean_midpoint`.
    """
    count, replacements = directions.shape[:2]
    all_origins = np.tile(rays.origins, (count, replacements, 1, 1))
    all_directions = np.tile(rays.directions, (count, replacements, 1, 1))
    rows = np.arange(count)
    all_origins[rows, :, rows] = origins
    all_directions[rows, :, rows] = directions
    means = mean_midpoint(all_origins, all_directions, pairs)
    return np.swapaxes(means[:, 0::2] - means[:, 1::2], 1, 2)


def _perturbed(rays: Rays) -> tuple[Floats, Floats]:
    """Each ray with its camera moved by plus and minus a step along each of six axes (n, 12, 3)."""
    signed = _STEP_POSE * np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(6, 3)
    origins = rays.origins[:, None].repeat(12, axis=1)
    directions = rays.directions[:, None].repeat(12, axis=1)
    origins[:, :6] += signed
    directions[:, 6:] += np.cross(signed, rays.directions[:, None])
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)
