"""The inner loop of the ray caster, compiled: what a ray meets first.

Shapes come as rows of numbers, everything in the camera's frame. A ray is
`origin + depth * (x, y, 1)`; its origin is the camera, less the way the shape has moved while a
rolling shutter ran.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

from measure.arrays import Bools, Floats, Ints

F = TypeVar("F", bound=Callable[..., object])

SPHERE, CAPSULE, BOX = 0.0, 1.0, 2.0
KIND, A, B, RADIUS, TURN, VELOCITY, REFLECTANCE, ROUGHNESS, ROW = 0, 1, 4, 7, 8, 17, 20, 21, 22
"""Columns of a shape's row: kind; centre or start; end or half size; radius; rotation (9); ..."""
NOTHING = -1


def compiled(function: F) -> F:
    """Numba's njit, keeping the types; results are the same on every run and thread."""
    return cast("F", njit(cache=True, nogil=True, error_model="numpy")(function))


@compiled
def trace(
    ideal: Floats,
    near: Bools,
    rays_per_row: int,
    delays_s: Floats,
    shapes: Floats,
    first: Ints,
    depth: Floats,
) -> None:
    """Find what each ray meets first.

    Args:
        ideal: (n, 2) undistorted normalised image coordinates.
        near: (n / rays_per_row, k) which shapes the rays of a pixel may meet.
        rays_per_row: how many consecutive rays share a row of `near`.
        delays_s: (n / rays_per_row,) when they are cast, after the time the shapes are given for.
        shapes: (k, ROW).
        first: (n,) receives the index of the shape, or `NOTHING`.
        depth: (n,) receives the depth, or infinity.
    """
    for i in range(len(ideal)):
        row = i // rays_per_row
        nearest, found = math.inf, NOTHING
        for k in range(len(shapes)):
            if near[row, k]:
                d = _enter(shapes[k], ideal[i, 0], ideal[i, 1], delays_s[row])
                if d < nearest:
                    nearest, found = d, k
        first[i], depth[i] = found, nearest


@compiled
def _enter(shape: Floats, x: float, y: float, delay: float) -> float:
    """Depth at which a ray enters a shape, infinity if it misses."""
    ax = shape[A] + delay * shape[VELOCITY]
    ay = shape[A + 1] + delay * shape[VELOCITY + 1]
    az = shape[A + 2] + delay * shape[VELOCITY + 2]
    if shape[KIND] == SPHERE:
        return _enter_sphere(ax, ay, az, shape[RADIUS], x, y)
    if shape[KIND] == BOX:
        return _enter_box(shape, ax, ay, az, x, y)
    # A rod: its round side between the ends, or one of the end balls.
    ux, uy, uz = shape[B] - shape[A], shape[B + 1] - shape[A + 1], shape[B + 2] - shape[A + 2]
    length2 = ux * ux + uy * uy + uz * uz
    along_d = (x * ux + y * uy + uz) / length2
    along_a = (ax * ux + ay * uy + az * uz) / length2
    dx, dy, dz = x - along_d * ux, y - along_d * uy, 1.0 - along_d * uz
    px, py, pz = ax - along_a * ux, ay - along_a * uy, az - along_a * uz
    a = dx * dx + dy * dy + dz * dz
    b = dx * px + dy * py + dz * pz
    inside = b * b - a * (px * px + py * py + pz * pz - shape[RADIUS] ** 2)
    best = math.inf
    if inside > 0 and a > 0:
        d = (b - math.sqrt(inside)) / a
        where = d * along_d - along_a
        if d > 0 and 0 <= where <= 1:
            best = d
    start = _enter_sphere(ax, ay, az, shape[RADIUS], x, y)
    end = _enter_sphere(ax + ux, ay + uy, az + uz, shape[RADIUS], x, y)
    return min(best, start, end)


@compiled
def _enter_sphere(cx: float, cy: float, cz: float, radius: float, x: float, y: float) -> float:
    a = x * x + y * y + 1.0
    b = x * cx + y * cy + cz
    inside = b * b - a * (cx * cx + cy * cy + cz * cz - radius * radius)
    if inside <= 0:
        return math.inf
    d = (b - math.sqrt(inside)) / a
    return d if d > 0 else math.inf


@compiled
def _enter_box(shape: Floats, cx: float, cy: float, cz: float, x: float, y: float) -> float:
    enter, leave = 0.0, math.inf
    for axis in range(3):
        rx, ry, rz = shape[TURN + axis], shape[TURN + 3 + axis], shape[TURN + 6 + axis]
        along = x * rx + y * ry + rz
        center = cx * rx + cy * ry + cz * rz
        half = shape[B + axis]
        if abs(along) < 1e-12:
            if abs(center) > half:
                return math.inf
            continue
        near, far = (center - half) / along, (center + half) / along
        enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
    return enter if 0 < enter < leave else math.inf
