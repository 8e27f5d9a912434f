"""The lens model of `distortion.py` in compiled code: one point, and rays of many pixels at once.

A lens is a row of 13 numbers, `Intrinsics.row`: fx skew cx fy cy k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined

Numbers = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float
]
"""A lens row as a tuple, see `lens_numbers`: `distort_point` and `to_pixel` take either."""
NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-5
"""Newton's steps shrink quadratically: after one so short less than 1e-9 is left."""


@compiled
def lens_numbers(lens: Floats) -> Numbers:
    """A lens row (13,) as a tuple: the compiler keeps it in registers and vectorises the loop."""
    return (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8], lens[9],
        lens[10], lens[11], lens[12],
    )  # fmt: skip


@compiled
def distort_point(x: float, y: float, lens: Floats | Numbers) -> tuple[float, float]:
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
    u, v = distort_point(x / z, y / z, lens)
    return lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]


@compiled
def distortion_slopes(x: float, y: float, lens: Floats) -> tuple[float, float, float, float]:
    """Derivatives of `distort_point`: of u by x and y, of v by x and y."""
    r2 = x * x + y * y
    above = 1 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    below = 1 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    radial = above / below
    rise = lens[5] + r2 * (2 * lens[6] + r2 * 3 * lens[9])
    rise -= radial * (lens[10] + r2 * (2 * lens[11] + r2 * 3 * lens[12]))
    rise *= 2 / below
    p1, p2 = lens[7], lens[8]
    across = x * y * rise + 2 * p1 * x + 2 * p2 * y
    return (
        radial + x * x * rise + 2 * p1 * y + 6 * p2 * x,
        across,
        across,
        radial + y * y * rise + 6 * p1 * y + 2 * p2 * x,
    )


@compiled
def bearing(pixel: Floats, lens: Floats) -> Floats:
    """Unit bearing (3,) of a pixel (2,); NaN where the lens model has no inverse."""
    yd = (pixel[1] - lens[4]) / lens[3]
    xd = (pixel[0] - lens[2] - lens[1] * yd) / lens[0]
    x, y = xd, yd
    for _ in range(NEWTON_STEPS):
        u, v = distort_point(x, y, lens)
        a, b, c, d = distortion_slopes(x, y, lens)
        det = a * d - b * c
        step_x, step_y = (d * (xd - u) - b * (yd - v)) / det, (a * (yd - v) - c * (xd - u)) / det
        x, y = x + step_x, y + step_y
        if abs(step_x) + abs(step_y) < NEWTON_TOLERANCE:
            return np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1)
    return np.full(3, np.nan)


RAY = 9
"""Rows of a ray: the unit bearing's x, y, z, then the derivatives by those of u, then of v."""


@compiled
def fill_rays(pixels: Floats, start: int, end: int, lens: Floats, out: Floats) -> None:
    """Fill the rays (9, n) of pixels from `start` to `end`; NaN where the lens has no inverse.

    Args:
        pixels: (n, 2).
        start: the first of them.
        end: behind the last of them.
        lens: (13,).
        out: (9, n) filled.
    """
    first, n = np.uint64(start), np.uint64(end - start)
    distorted_x, distorted_y = np.empty(n), np.empty(n)
    for i in range(n):
        distorted_y[i] = (pixels[first + i, 1] - lens[4]) / lens[3]
    for i in range(n):
        distorted_x[i] = (pixels[first + i, 0] - lens[2] - lens[1] * distorted_y[i]) / lens[0]
    x, y = distorted_x.copy(), distorted_y.copy()
    for _ in range(NEWTON_STEPS):
        if _newton_step(distorted_x, distorted_y, lens, x, y) == 0:
            break
    else:
        _reject_unconverged(distorted_x, distorted_y, lens, x, y)
    _fill_bearings(x, y, first, out)
    _fill_slopes(x, y, lens, first, out)


@inlined
def _newton_step(
    distorted_x: Floats, distorted_y: Floats, lens: Floats, x: Floats, y: Floats
) -> int:
    """One Newton step of the points (n,) towards those that the lens distorts to the given ones.

    Returns:
        How many of the steps were longer than the tolerance.
    """
    long = 0
    for i in range(len(x)):
        u, v = distort_point(x[i], y[i], lens)
        a, b, c, d = distortion_slopes(x[i], y[i], lens)
        unit, u, v = 1 / (a * d - b * c), distorted_x[i] - u, distorted_y[i] - v
        step_x, step_y = (d * u - b * v) * unit, (a * v - c * u) * unit
        x[i] += step_x
        y[i] += step_y
        long += int(not abs(step_x) + abs(step_y) < NEWTON_TOLERANCE)
    return long


@inlined
def _reject_unconverged(
    distorted_x: Floats, distorted_y: Floats, lens: Floats, x: Floats, y: Floats
) -> None:
    """Set to NaN the points that the lens does not distort to the given ones."""
    for i in range(len(x)):
        u, v = distort_point(x[i], y[i], lens)
        if not abs(distorted_x[i] - u) + abs(distorted_y[i] - v) < NEWTON_TOLERANCE:
            x[i] = np.nan


@inlined
def _fill_bearings(x: Floats, y: Floats, first: np.uint64, out: Floats) -> None:
    for i in range(np.uint64(len(x))):
        out[2, first + i] = 1 / np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
    for i in range(np.uint64(len(x))):
        out[0, first + i], out[1, first + i] = x[i] * out[2, first + i], y[i] * out[2, first + i]


@inlined
def _fill_slopes(x: Floats, y: Floats, lens: Floats, first: np.uint64, out: Floats) -> None:
    """Fill the pixels' derivatives; those by the bearing's z follow from those by x and y."""
    n = np.uint64(len(x))
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        a, b, c, d = distortion_slopes(x[i], y[i], lens)
        out[3, first + i] = (lens[0] * a + lens[1] * c) * length
        out[4, first + i] = (lens[0] * b + lens[1] * d) * length
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        _, _, c, d = distortion_slopes(x[i], y[i], lens)
        out[6, first + i], out[7, first + i] = lens[3] * c * length, lens[3] * d * length
    for i in range(n):
        out[5, first + i] = -(out[3, first + i] * x[i] + out[4, first + i] * y[i])
    for i in range(n):
        out[8, first + i] = -(out[6, first + i] * x[i] + out[7, first + i] * y[i])
