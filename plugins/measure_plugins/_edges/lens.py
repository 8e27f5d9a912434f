"""The lens as a row of numbers, and its compiled projection and inverse (model/distortion.py)."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.model import Intrinsics
from measure_plugins._edges.jit import compiled

_NEWTON_STEPS = 20


def lens_row(intrinsics: Intrinsics) -> Floats:
    """Fx skew cx fy cy k1 k2 p1 p2 k3 k4 k5 k6 as (13,)."""
    k = intrinsics.matrix
    return np.concatenate([[k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]], intrinsics.distortion])


@compiled
def bend(x: float, y: float, lens: Floats) -> tuple[float, float]:
    """Distort a normalised image point."""
    r2 = x * x + y * y
    above = 1 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    below = 1 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    radial = above / below
    p1, p2 = lens[7], lens[8]
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@compiled
def to_pixel(x: float, y: float, z: float, lens: Floats) -> tuple[float, float]:
    """Pixel of a camera-frame point in front of the camera."""
    u, v = bend(x / z, y / z, lens)
    return lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]


@compiled
def to_bearing(u: float, v: float, lens: Floats) -> tuple[float, float, float]:
    """Unit bearing of a pixel; NaN where the lens model has no inverse."""
    yd = (v - lens[4]) / lens[3]
    xd = (u - lens[2] - lens[1] * yd) / lens[0]
    x, y = xd, yd
    h = 1e-6
    for _ in range(_NEWTON_STEPS):
        fx, fy = bend(x, y, lens)
        ax, ay = bend(x + h, y, lens)
        bx, by = bend(x, y + h, lens)
        a, b, c, d = (ax - fx) / h, (bx - fx) / h, (ay - fy) / h, (by - fy) / h
        det = a * d - b * c
        ex, ey = xd - fx, yd - fy
        dx, dy = (d * ex - b * ey) / det, (a * ey - c * ex) / det
        x, y = x + dx, y + dy
        if abs(dx) + abs(dy) < 1e-11:
            n = np.sqrt(x * x + y * y + 1)
            return x / n, y / n, 1 / n
    return np.nan, np.nan, np.nan
