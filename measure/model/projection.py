"""Projection through many cameras at once, row by row, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.camera_rows import MIN_DEPTH_MM, RigRows
from measure.model.lens import by_lens, distort_point, distortion_slopes, ideal_point


@compiled
def project_one(
    rig: RigRows, row: int, point: Floats, pixel: Floats, by_point: Floats
) -> tuple[float, float]:
    """Project a world point into the camera of a row; NaN where it has no image.

    Args:
        point: (3,) mm.
        pixel: (2,) filled.
        by_point: (2, 3) filled with the pixel's derivatives by the world point.

    Returns:
        The normalised image point, lens left out.
    """
    lens, reach, rotation = rig.lenses[row], rig.reach[row], rig.rotation[row]
    center = rig.centers[row]
    dx, dy, dz = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    px = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    py = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    pz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    x, y = px / pz, py / pz
    if not (pz > MIN_DEPTH_MM and x * x + y * y < reach * reach):
        pixel[:] = np.nan
        by_point[:] = np.nan
        return np.nan, np.nan
    u, v = distort_point(x, y, lens)
    pixel[0], pixel[1] = lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]
    a, b, c, d = distortion_slopes(x, y, lens)
    ux, uy = (lens[0] * a + lens[1] * c) / pz, (lens[0] * b + lens[1] * d) / pz
    vx, vy = lens[3] * c / pz, lens[3] * d / pz
    uz, vz = -(ux * x + uy * y), -(vx * x + vy * y)
    for k in range(3):
        by_point[0, k] = ux * rotation[k, 0] + uy * rotation[k, 1] + uz * rotation[k, 2]
        by_point[1, k] = vx * rotation[k, 0] + vy * rotation[k, 1] + vz * rotation[k, 2]
    return x, y


@compiled
def by_cameras(rig: RigRows, points: Floats) -> Floats:
    """Derivatives of the pixel of point i in camera i, or in a single one, by that camera.

    A camera's pose changes in its `perturb` chart: moving it by (dt, w) moves the point, as the
    camera sees it, by -dt - w x (X - t).

    Returns:
        (n, 2, 18) by the pose and by the intrinsics, see `by_lens`.
    """
    out = np.zeros((len(points), 2, 18))
    pixel, by_point = np.empty(2), np.empty((2, 3))
    for i in range(len(points)):
        row = i % len(rig.lenses)
        x, y = project_one(rig, row, points[i], pixel, by_point)
        away = points[i] - rig.centers[row]
        for a in range(2):
            for b in range(3):
                c, d = (b + 1) % 3, (b + 2) % 3
                out[i, a, b] = -by_point[a, b]
                out[i, a, 3 + b] = by_point[a, c] * away[d] - by_point[a, d] * away[c]
        by_lens(x, y, rig.lenses[row], out[i, :, 6:])
    return out


@compiled
def camera_noise(rig: RigRows, points: Floats) -> Floats:
    """What uncertain cameras add to the covariances (n, 2, 2) of the pixels of points (n, 3)."""
    out = np.zeros((len(points), 2, 2))
    if not np.any(rig.covariances):
        return out
    by_camera = by_cameras(rig, points)
    for i in range(len(points)):
        out[i] = by_camera[i] @ rig.covariances[i] @ by_camera[i].T
    return out


@compiled
def project_rows(rig: RigRows, points: Floats) -> tuple[Floats, Floats]:
    """`project_one` of point i into camera i, or all into a single one: (n, 2), (n, 2, 3)."""
    pixels, by_point = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    for i in range(len(points)):
        project_one(rig, i % len(rig.lenses), points[i], pixels[i], by_point[i])
    return pixels, by_point


@compiled
def ray_rows(pixels: Floats, rig: RigRows) -> Floats:
    """Unit directions (n, 3) in the world of pixel i (n, 2) in camera i, or all in a single one.

    NaN where the lens has no inverse.
    """
    out = np.empty((len(pixels), 3))
    for i in range(len(pixels)):
        k = i % len(rig.lenses)
        x, y = ideal_point(pixels[i], rig.lenses[k], rig.reach[k])
        length = np.sqrt(x * x + y * y + 1)
        for a in range(3):
            turned = rig.rotation[k, a, 0] * x + rig.rotation[k, a, 1] * y + rig.rotation[k, a, 2]
            out[i, a] = turned / length
    return out


@compiled
def rows_between(rig: RigRows, start: int, end: int) -> RigRows:
    """The cameras of the rows from `start` to before `end`."""
    return RigRows(
        rig.lenses[start:end],
        rig.reach[start:end],
        rig.rotation[start:end],
        rig.centers[start:end],
        rig.covariances[start:end],
    )
