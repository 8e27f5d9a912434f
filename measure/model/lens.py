"""The lens model in compiled code: `distortion.py` for one point and a row of numbers.

The row is `Intrinsics.row`: fx skew cx fy cy k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled

Numbers = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float
]
"""A lens row as `lens_numbers` has it: `bend` and `to_pixel` take either."""
NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-5
"""Steps shrink by their square: one so short leaves less than 1e-9."""


@compiled
def lens_numbers(lens: Floats) -> Numbers:
    """A lens row (13,) that stays at hand in a loop over many points, which then sees several."""
    return (
        lens[0],
        lens[1],
        lens[2],
        lens[3],
        lens[4],
        lens[5],
        lens[6],
        lens[7],
        lens[8],
        lens[9],
        lens[10],
        lens[11],
        lens[12],
    )


@compiled
def bend(x: float, y: float, lens: Floats | Numbers) -> tuple[float, float]:
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
def to_pixel(x: float, y: float, z: float, lens: Floats | Numbers) -> tuple[float, float]:
    """Pixel of a camera-frame point in front of the camera."""
    u, v = bend(x / z, y / z, lens)
    return lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]


@compiled
def bend_slopes(x: float, y: float, lens: Floats) -> tuple[float, float, float, float]:
    """Derivatives of `bend`: of u by x and y, of v by x and y."""
    r2 = x * x + y * y
    above = 1 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    below = 1 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    radial = above / below
    rise = lens[5] + r2 * (2 * lens[6] + r2 * 3 * lens[9])
    rise -= radial * (lens[10] + r2 * (2 * lens[11] + r2 * 3 * lens[12]))
    rise *= 2 / below
    p1, p2 = lens[7], lens[8]
    aside = x * y * rise + 2 * p1 * x + 2 * p2 * y
    return (
        radial + x * x * rise + 2 * p1 * y + 6 * p2 * x,
        aside,
        aside,
        radial + y * y * rise + 6 * p1 * y + 2 * p2 * x,
    )


@compiled
def bearing(pixel: Floats, lens: Floats) -> Floats:
    """Unit bearing (3,) of a pixel (2,); NaN where the lens model has no inverse."""
    yd = (pixel[1] - lens[4]) / lens[3]
    xd = (pixel[0] - lens[2] - lens[1] * yd) / lens[0]
    x, y = xd, yd
    for _ in range(NEWTON_STEPS):
        u, v = bend(x, y, lens)
        a, b, c, d = bend_slopes(x, y, lens)
        det = a * d - b * c
        step_x, step_y = (d * (xd - u) - b * (yd - v)) / det, (a * (yd - v) - c * (xd - u)) / det
        x, y = x + step_x, y + step_y
        if abs(step_x) + abs(step_y) < NEWTON_TOLERANCE:
            return np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1)
    return np.full(3, np.nan)
