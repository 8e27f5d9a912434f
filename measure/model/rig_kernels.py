"""Projection through many cameras at once, row by row, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.lens import by_lens, distort_point, distortion_slopes, ideal_point
from measure.model.rig import RigRows


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
def by_intrinsics(points: Floats, lens: Floats) -> Floats:
    """Derivatives (n, 2, 12) of the pixels of camera-frame points (n, 3), see `by_lens`."""
    out = np.zeros((len(points), 2, 12))
    for i in range(len(points)):
        by_lens(points[i, 0] / points[i, 2], points[i, 1] / points[i, 2], lens, out[i])
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
        rig.min_depth,
    )
