"""Derivatives of pixels by the point and by the cameras that show it, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.lens import by_lens
from measure.model.rig import RigRows
from measure.model.rig_kernels import project_one


@compiled
def sensitivities(rig: RigRows, seen: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2) of points (n, 3); their Jacobians by the points and the cameras' poses.

    A camera's pose changes in its `perturb` chart: moving it by (dt, w) moves the point, as the
    camera sees it, by -dt - w x (X - t).

    Returns:
        (n, 2), (n, 2, 3) and (n, 2, 6).
    """
    n = len(seen)
    pixels, by_point, by_pose = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 6))
    for i in range(n):
        project_one(rig, i, seen[i], pixels[i], by_point[i])
        x, y = seen[i, 0] - rig.centers[i, 0], seen[i, 1] - rig.centers[i, 1]
        z = seen[i, 2] - rig.centers[i, 2]
        for a in range(2):
            p, q, r = by_point[i, a]
            by_pose[i, a, 0], by_pose[i, a, 1], by_pose[i, a, 2] = -p, -q, -r
            by_pose[i, a, 3] = q * z - r * y
            by_pose[i, a, 4] = r * x - p * z
            by_pose[i, a, 5] = p * y - q * x
    return pixels, by_point, by_pose


@compiled
def by_cameras(rig: RigRows, seen: Floats, by_pose: Floats) -> Floats:
    """Jacobians (n, 2, 18) of pixels by poses and intrinsics; zero where nothing is uncertain."""
    out = np.zeros((len(seen), 2, 18))
    for i in range(len(seen)):
        if _uncertain(rig.covariances[i, :6]):
            out[i, :, :6] = by_pose[i]
        if _uncertain(rig.covariances[i, 6:]):
            x, y = ideal(rig.rotation[i], rig.centers[i], seen[i])
            by_lens(x, y, rig.lenses[i], out[i, :, 6:])
    return out


@compiled
def ideal(rotation: Floats, center: Floats, point: Floats) -> tuple[float, float]:
    """The normalised image point, lens left out, of a world point."""
    dx, dy, dz = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    px = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    py = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    pz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    return px / pz, py / pz


@compiled
def camera_noise(rig: RigRows, seen: Floats) -> Floats:
    """What uncertain cameras add to the covariances (n, 2, 2) of the pixels of points (n, 3)."""
    out = np.zeros((len(seen), 2, 2))
    if not np.any(rig.covariances):
        return out
    _, _, by_pose = sensitivities(rig, seen)
    by_camera = by_cameras(rig, seen, by_pose)
    for i in range(len(seen)):
        out[i] = by_camera[i] @ rig.covariances[i] @ by_camera[i].T
    return out


@compiled
def _uncertain(rows: Floats) -> bool:
    """Whether some rows of a covariance hold anything: one unknown alone may be uncertain."""
    for row in rows:
        for value in row:
            if value != 0:
                return True
    return False
