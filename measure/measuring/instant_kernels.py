"""A moving body's balls in pictures of different times, compiled: see `instants`."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.covariance_kernels import inverse_2x2
from measure.geometry.linear_kernels import invert_scaled
from measure.geometry.rotation_kernels import times, turned
from measure.model.rig_kernels import project_one

_SINGULAR = 1e-9
"""Of equations, relative to the best determined unknown."""


@compiled
def carried_pixels(
    lenses: Floats,
    reach: Floats,
    rig_rotation: Floats,
    rig_centers: Floats,
    points_body: Floats,
    rotation: Floats,
    translation: Floats,
    moved: Floats,
    min_depth: float,
) -> Floats:
    """Pixels (n, 2) of n points of a body; NaN for points without an image.

    Args:
        lenses: (n, 13).
        reach: (n,) of the lens models.
        rig_rotation: (n, 3, 3) of world_from_camera.
        rig_centers: (n, 3).
        points_body: (n, 3).
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        moved: (n, 6) how far the body has moved from there in each picture, mm and rad.
        min_depth: see `rig_kernels.project_one`.
    """
    out, by_point, place = np.empty((len(lenses), 2)), np.empty((2, 3)), np.empty(3)
    for i in range(len(lenses)):
        arm = times(rotation, points_body[i])
        x, y, z = turned(moved[i, 3], moved[i, 4], moved[i, 5], arm)
        place[0] = x + translation[0] + moved[i, 0]
        place[1] = y + translation[1] + moved[i, 1]
        place[2] = z + translation[2] + moved[i, 2]
        project_one(
            lenses[i], reach[i], rig_rotation[i], rig_centers[i], place, min_depth, out[i],
            by_point,
        )  # fmt: skip
    return out


@compiled
def velocity_share(
    lenses: Floats,
    reach: Floats,
    rig_rotation: Floats,
    rig_centers: Floats,
    points_body: Floats,
    noise: Floats,
    lead_s: Floats,
    rotation: Floats,
    translation: Floats,
    velocity: Floats,
    velocity_covariance: Floats,
    acceleration_square: Floats,
    common_px: float,
    min_depth: float,
) -> Floats:
    """Covariance (6, 6) of a pose fitted to n points: see `instants.Seen.velocity_share`.

    Points without an image say nothing.

    Args:
        lenses: (n, 13).
        reach: (n,) of the lens models.
        rig_rotation: (n, 3, 3) of world_from_camera.
        rig_centers: (n, 3).
        points_body: (n, 3).
        noise: (n, 2, 2) covariances of the pixels.
        lead_s: (n,) times of the pictures after the pose's.
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        velocity: (6,) mm/s and rad/s in the world.
        velocity_covariance: (6, 6) of that.
        acceleration_square: (6, 6) mean square of what changes it, mm/s^2 and rad/s^2.
        common_px: added to the pixels' standard deviations in quadrature.
        min_depth: see `rig_kernels.project_one`.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 12))
    pixel, by_point, slopes = np.empty(2), np.empty((2, 3)), np.empty((2, 6))
    variance = common_px**2 * np.eye(2)
    for i in range(len(lenses)):
        arm, lead = times(rotation, points_body[i]), lead_s[i]
        swung = np.cross(velocity[3:], arm)
        project_one(
            lenses[i], reach[i], rig_rotation[i], rig_centers[i],
            arm + translation + lead * (velocity[:3] + swung), min_depth, pixel, by_point,
        )  # fmt: skip
        if np.isnan(pixel[0]):
            continue
        slopes[:, :3] = by_point
        for u in range(2):
            slopes[u, 3:] = np.cross(arm, by_point[u])
        weight = inverse_2x2(noise[i] + variance)
        for a in range(6):
            right = weight[0, 0] * slopes[0, a] + weight[1, 0] * slopes[1, a]
            down = weight[0, 1] * slopes[0, a] + weight[1, 1] * slopes[1, a]
            for b in range(6):
                share = right * slopes[0, b] + down * slopes[1, b]
                normal[a, b] += share
                moved[a, b] += lead * share
                moved[a, 6 + b] += lead * lead / 2 * share
    lever = levers(normal, moved)
    swing, bend = lever[:, :6].copy(), lever[:, 6:].copy()
    return swing @ velocity_covariance @ swing.T + bend @ acceleration_square @ bend.T


@compiled
def levers(normal: Floats, moved: Floats) -> Floats:
    """What normal equations (6, 6) make of their right sides (6, 12); the least that they may.

    One ball alone leaves a turn open: its pose is the prediction's, whatever the velocity.
    """
    inverse = np.empty((6, 6))
    if invert_scaled(normal.copy(), inverse) < 1 / _SINGULAR:
        return inverse @ moved
    return np.linalg.lstsq(normal, moved, _SINGULAR)[0].astype(np.float64)
