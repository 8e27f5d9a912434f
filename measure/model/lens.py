"""OpenCV's lens models, compiled: pixels of points, rays of pixels, and derivatives.

A pinhole bends normalised image coordinates (X/Z, Y/Z) by a rational radial and a tangential
polynomial (Brown 1966; OpenCV calib3d, "Detailed description"). A fisheye images a ray at the angle
t off its axis at the distance t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from it (Kannala and Brandt
2006; "Fisheye camera model").

A lens is a row of 16 numbers, `Intrinsics.row`: fx skew cx fy cy, the eight distortion coefficients
(k1 k2 p1 p2 k3 k4 k5 k6 of a pinhole; k1 k2 k3 k4 of a fisheye, and zeros), `FISHEYE`, and the
lateral colour of red and blue. Loops over many points choose the model before they begin, so that
the compiler can vectorise them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.limits import MAX_STEPS

FISHEYE = 13
"""Where a lens row holds the angle off the axis up to which a fisheye sees, rad; 0: a pinhole."""
RED, BLUE = 14, 15
"""Where it holds the magnification of red and of blue against green, less 1."""
Slopes = Callable[[float, float, Floats], tuple[float, float, float, float]]
NEWTON_TOLERANCE = 1e-5
"""Newton's steps shrink quadratically: after one so short less than 1e-9 is left."""
_EXACT, _FAILED = 1e-12, 1e-9
TINY = 1e-20
"""Square of a radius at which a fisheye bends nothing: it keeps zero out of divisions."""


@compiled
def distort_point(x: float, y: float, lens: Floats) -> tuple[float, float]:
    """Distort a normalised image point; NaN beyond what a fisheye sees."""
    if lens[FISHEYE] > 0:
        return fisheye_point(x, y, lens)
    return pinhole_point(x, y, lens)


@compiled
def distortion_slopes(x: float, y: float, lens: Floats) -> tuple[float, float, float, float]:
    """Derivatives of `distort_point`: of u by x and y, of v by x and y."""
    if lens[FISHEYE] > 0:
        return fisheye_slopes(x, y, lens)
    return pinhole_slopes(x, y, lens)


@compiled
def to_pixel(x: float, y: float, z: float, lens: Floats) -> tuple[float, float]:
    """Pixel of a camera-frame point in front of the camera; NaN beyond what a fisheye sees."""
    if lens[FISHEYE] > 0 and not z > 0:
        return np.nan, np.nan
    u, v = distort_point(x / z, y / z, lens)
    return lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]


@inlined
def fisheye_point(x: float, y: float, lens: Floats) -> tuple[float, float]:
    """`distort_point` of a fisheye."""
    r = np.sqrt(max(x * x + y * y, TINY))
    angle = np.arctan(r)
    if not angle < lens[FISHEYE]:
        return np.nan, np.nan
    scale = _bent_angle(angle, lens) / r
    return x * scale, y * scale


@inlined
def fisheye_slopes(x: float, y: float, lens: Floats) -> tuple[float, float, float, float]:
    """`distortion_slopes` of a fisheye."""
    r2 = max(x * x + y * y, TINY)
    r = np.sqrt(r2)
    angle = np.arctan(r)
    scale = _bent_angle(angle, lens) / r
    rise = (_bending(angle, lens) / (1 + r2) - scale) / r2
    return scale + x * x * rise, x * y * rise, x * y * rise, scale + y * y * rise


@inlined
def _bent_angle(angle: float, lens: Floats) -> float:
    t = angle * angle
    return angle * (1 + t * (lens[5] + t * (lens[6] + t * (lens[7] + t * lens[8]))))


@inlined
def _bending(angle: float, lens: Floats) -> float:
    """Derivative of `_bent_angle`."""
    t = angle * angle
    return 1 + t * (3 * lens[5] + t * (5 * lens[6] + t * (7 * lens[7] + t * 9 * lens[8])))


@compiled
def fisheye_ideal(x: float, y: float, lens: Floats) -> tuple[float, float]:
    """The ideal point that a fisheye distorts to (x, y); NaN beyond what it sees.

    Newton's method within bounds, which always converges: the bent angle grows with the angle.
    """
    bent, low, high = np.sqrt(max(x * x + y * y, TINY)), 0.0, lens[FISHEYE]
    if not bent < _bent_angle(high, lens):
        return np.nan, np.nan
    angle = min(bent, high)
    for _ in range(MAX_STEPS):
        off = _bent_angle(angle, lens) - bent
        if off > 0:
            high = angle
        else:
            low = angle
        closer = angle - off / _bending(angle, lens)
        if not low <= closer <= high:
            closer = (low + high) / 2
        step, angle = abs(closer - angle), closer
        if step < _EXACT:
            break
    scale = np.tan(angle) / bent
    return x * scale, y * scale


@compiled
def pinhole_point(x: float, y: float, lens: Floats) -> tuple[float, float]:
    """`distort_point` of a pinhole."""
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
def pinhole_slopes(x: float, y: float, lens: Floats) -> tuple[float, float, float, float]:
    """`distortion_slopes` of a pinhole."""
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
    x, y = ideal_point(pixel, lens, np.inf)
    return np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1)


@compiled
def ideal_point(pixel: Floats, lens: Floats, reach: float) -> tuple[float, float]:
    """The undistorted normalised point of a pixel (Newton); NaN where the lens has no inverse."""
    yd = (pixel[1] - lens[4]) / lens[3]
    xd = (pixel[0] - lens[2] - lens[1] * yd) / lens[0]
    if lens[FISHEYE] > 0:
        return fisheye_ideal(xd, yd, lens)
    x, y, size, det = xd, yd, np.inf, 1.0
    for _ in range(MAX_STEPS):
        u, v = pinhole_point(x, y, lens)
        a, b, c, d = pinhole_slopes(x, y, lens)
        det = a * d - b * c
        step_x, step_y = (d * (xd - u) - b * (yd - v)) / det, (a * (yd - v) - c * (xd - u)) / det
        x, y = x + step_x, y + step_y
        size = max(abs(step_x), abs(step_y))
        if not size > _EXACT:
            break
    if size < _FAILED and det > 0 and x * x + y * y < reach * reach:
        return x, y
    return np.nan, np.nan


RAY = 9
"""Rows of a ray: the unit bearing's x, y, z, then the derivatives by those of u, then of v."""


@compiled
def fill_rays(pixels: Floats, start: int, end: int, lens: Floats, out: Floats) -> None:
    """Fill the rays (9, n) of pixels from `start` to `end`; NaN where the lens has no inverse.

    Args:
        pixels: (n, 2).
        start: the first of them.
        end: behind the last of them.
        lens: (14,).
        out: (9, n) filled.
    """
    first, n = np.uint64(start), np.uint64(end - start)
    distorted_x, distorted_y = np.empty(n), np.empty(n)
    for i in range(n):
        distorted_y[i] = (pixels[first + i, 1] - lens[4]) / lens[3]
    for i in range(n):
        distorted_x[i] = (pixels[first + i, 0] - lens[2] - lens[1] * distorted_y[i]) / lens[0]
    x, y = distorted_x.copy(), distorted_y.copy()
    if lens[FISHEYE] > 0:
        for i in range(n):
            x[i], y[i] = fisheye_ideal(distorted_x[i], distorted_y[i], lens)
        _fill_bearings(x, y, first, out)
        _fill_slopes(x, y, lens, first, out, fisheye_slopes)
        return
    for _ in range(MAX_STEPS):
        if _newton_step(distorted_x, distorted_y, lens, x, y) == 0:
            break
    else:
        _reject_unconverged(distorted_x, distorted_y, lens, x, y)
    _fill_bearings(x, y, first, out)
    _fill_slopes(x, y, lens, first, out, pinhole_slopes)


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
        u, v = pinhole_point(x[i], y[i], lens)
        a, b, c, d = pinhole_slopes(x[i], y[i], lens)
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
        u, v = pinhole_point(x[i], y[i], lens)
        if not abs(distorted_x[i] - u) + abs(distorted_y[i] - v) < NEWTON_TOLERANCE:
            x[i] = np.nan


@inlined
def _fill_bearings(x: Floats, y: Floats, first: np.uint64, out: Floats) -> None:
    for i in range(np.uint64(len(x))):
        out[2, first + i] = 1 / np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
    for i in range(np.uint64(len(x))):
        out[0, first + i], out[1, first + i] = x[i] * out[2, first + i], y[i] * out[2, first + i]


@inlined
def _fill_slopes(
    x: Floats, y: Floats, lens: Floats, first: np.uint64, out: Floats, slopes: Slopes
) -> None:
    """Fill the pixels' derivatives; those by the bearing's z follow from those by x and y."""
    n = np.uint64(len(x))
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        a, b, c, d = slopes(x[i], y[i], lens)
        out[3, first + i] = (lens[0] * a + lens[1] * c) * length
        out[4, first + i] = (lens[0] * b + lens[1] * d) * length
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        _, _, c, d = slopes(x[i], y[i], lens)
        out[6, first + i], out[7, first + i] = lens[3] * c * length, lens[3] * d * length
    for i in range(n):
        out[5, first + i] = -(out[3, first + i] * x[i] + out[4, first + i] * y[i])
    for i in range(n):
        out[8, first + i] = -(out[6, first + i] * x[i] + out[7, first + i] * y[i])


@compiled
def by_lens(x: float, y: float, lens: Floats, out: Floats) -> None:
    """A pixel's derivatives (2, 12) by fx fy cx cy and the eight distortion coefficients."""
    r2 = x * x + y * y
    out[0, 0], out[1, 1] = distort_point(x, y, lens)
    out[0, 2] = out[1, 3] = 1.0
    if lens[FISHEYE] > 0:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        gain = angle * angle * (angle / r if r > 0 else 1.0)
        for power in range(4):
            _lens_column(out, 4 + power, x * gain, y * gain, lens)
            gain *= angle * angle
        return
    below = 1 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    radial = (1 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))) / below
    for power in range(3):
        gain = r2 ** (power + 1) / below
        above = 8 if power == 2 else 4 + power
        _lens_column(out, above, x * gain, y * gain, lens)
        _lens_column(out, 9 + power, -radial * x * gain, -radial * y * gain, lens)
    _lens_column(out, 6, 2 * x * y, r2 + 2 * y * y, lens)
    _lens_column(out, 7, r2 + 2 * x * x, 2 * x * y, lens)


@compiled
def _lens_column(out: Floats, column: int, du: float, dv: float, lens: Floats) -> None:
    out[0, column] = lens[0] * du + lens[1] * dv
    out[1, column] = lens[3] * dv
