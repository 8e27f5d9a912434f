"""Projection through many cameras at once, row by row, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.lens import (
    FISHEYE,
    distort_point,
    distortion_slopes,
    fisheye_ideal,
    pinhole_point,
    pinhole_slopes,
)
from measure.model.rig import RigRows

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-12
_NEWTON_FAILED = 1e-9


@compiled
def project_one(rig: RigRows, row: int, point: Floats, pixel: Floats, by_point: Floats) -> None:
    """Project a world point into the camera of a row; NaN where it has no image.

    Args:
        rig: the cameras.
        row: which of them.
        point: (3,) mm.
        pixel: (2,) filled.
        by_point: (2, 3) filled with the pixel's derivatives by the world point.
    """
    lens, reach, rotation = rig.lenses[row], rig.reach[row], rig.rotation[row]
    center = rig.centers[row]
    dx, dy, dz = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    px = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    py = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    pz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    x, y = px / pz, py / pz
    if not (pz > rig.min_depth and x * x + y * y < reach * reach):
        pixel[:] = np.nan
        by_point[:] = np.nan
        return
    u, v = distort_point(x, y, lens)
    pixel[0], pixel[1] = lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]
    a, b, c, d = distortion_slopes(x, y, lens)
    ux, uy = (lens[0] * a + lens[1] * c) / pz, (lens[0] * b + lens[1] * d) / pz
    vx, vy = lens[3] * c / pz, lens[3] * d / pz
    uz, vz = -(ux * x + uy * y), -(vx * x + vy * y)
    for k in range(3):
        by_point[0, k] = ux * rotation[k, 0] + uy * rotation[k, 1] + uz * rotation[k, 2]
        by_point[1, k] = vx * rotation[k, 0] + vy * rotation[k, 1] + vz * rotation[k, 2]


@compiled
def project_rows(rig: RigRows, points: Floats) -> tuple[Floats, Floats]:
    """`project_one` for every row: pixels (n, 2) and their derivatives (n, 2, 3)."""
    n = len(rig.lenses)
    pixels, by_point = np.empty((n, 2)), np.empty((n, 2, 3))
    for i in range(n):
        project_one(rig, i, points[i], pixels[i], by_point[i])
    return pixels, by_point


@compiled
def ideal_point(pixel: Floats, lens: Floats, reach: float) -> tuple[float, float]:
    """The undistorted normalised point of a pixel (Newton); NaN where the lens has no inverse."""
    yd = (pixel[1] - lens[4]) / lens[3]
    xd = (pixel[0] - lens[2] - lens[1] * yd) / lens[0]
    if lens[FISHEYE] > 0:
        return fisheye_ideal(xd, yd, lens)
    x, y, size, det = xd, yd, np.inf, 1.0
    for _ in range(_NEWTON_STEPS):
        u, v = pinhole_point(x, y, lens)
        a, b, c, d = pinhole_slopes(x, y, lens)
        det = a * d - b * c
        step_x, step_y = (d * (xd - u) - b * (yd - v)) / det, (a * (yd - v) - c * (xd - u)) / det
        x, y = x + step_x, y + step_y
        size = max(abs(step_x), abs(step_y))
        if not size > _NEWTON_TOLERANCE:
            break
    if size < _NEWTON_FAILED and det > 0 and x * x + y * y < reach * reach:
        return x, y
    return np.nan, np.nan


@compiled
def ray_rows(pixels: Floats, rig: RigRows) -> Floats:
    """Unit directions (n, 3) in the world of pixel i (n, 2) in camera i; NaN without an inverse."""
    out = np.empty((len(pixels), 3))
    for i in range(len(pixels)):
        x, y = ideal_point(pixels[i], rig.lenses[i], rig.reach[i])
        length = np.sqrt(x * x + y * y + 1)
        for k in range(3):
            turned = rig.rotation[i, k, 0] * x + rig.rotation[i, k, 1] * y + rig.rotation[i, k, 2]
            out[i, k] = turned / length
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
        rig.min_depth,
    )
