"""Rays of many pixels of one camera at once, compiled.

The loops are short, write one or two rows each, take no branches and count unsigned: those the
compiler turns into vectors.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.model.lens import NEWTON_STEPS, NEWTON_TOLERANCE, bend, bend_slopes

RAY = 9
"""Numbers of a ray: the unit bearing's x, y and z, and the pixel's derivatives by those, first u's,
then v's."""


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
    bent_x, bent_y = np.empty(n), np.empty(n)
    for i in range(n):
        bent_y[i] = (pixels[first + i, 1] - lens[4]) / lens[3]
    for i in range(n):
        bent_x[i] = (pixels[first + i, 0] - lens[2] - lens[1] * bent_y[i]) / lens[0]
    x, y = bent_x.copy(), bent_y.copy()
    for _ in range(NEWTON_STEPS):
        if _straighten(bent_x, bent_y, lens, x, y) == 0:
            break
    else:
        _give_up(bent_x, bent_y, lens, x, y)
    _fill_bearings(x, y, first, out)
    _fill_slopes(x, y, lens, first, out)


@inlined
def _straighten(bent_x: Floats, bent_y: Floats, lens: Floats, x: Floats, y: Floats) -> int:
    """Take one of Newton's steps towards the points (n,) that a lens bends to others.

    Returns:
        How many of the steps were long.
    """
    long = 0
    for i in range(len(x)):
        u, v = bend(x[i], y[i], lens)
        a, b, c, d = bend_slopes(x[i], y[i], lens)
        unit, u, v = 1 / (a * d - b * c), bent_x[i] - u, bent_y[i] - v
        step_x, step_y = (d * u - b * v) * unit, (a * v - c * u) * unit
        x[i] += step_x
        y[i] += step_y
        long += int(not abs(step_x) + abs(step_y) < NEWTON_TOLERANCE)
    return long


@inlined
def _give_up(bent_x: Floats, bent_y: Floats, lens: Floats, x: Floats, y: Floats) -> None:
    """Leave no number of points that the lens does not bend to the others."""
    for i in range(len(x)):
        u, v = bend(x[i], y[i], lens)
        if not abs(bent_x[i] - u) + abs(bent_y[i] - v) < NEWTON_TOLERANCE:
            x[i] = np.nan


@inlined
def _fill_bearings(x: Floats, y: Floats, first: np.uint64, out: Floats) -> None:
    for i in range(np.uint64(len(x))):
        out[2, first + i] = 1 / np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
    for i in range(np.uint64(len(x))):
        out[0, first + i], out[1, first + i] = x[i] * out[2, first + i], y[i] * out[2, first + i]


@inlined
def _fill_slopes(x: Floats, y: Floats, lens: Floats, first: np.uint64, out: Floats) -> None:
    """Fill the pixels' derivatives: by the bearing's z they follow from those by x and y."""
    n = np.uint64(len(x))
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        a, b, c, d = bend_slopes(x[i], y[i], lens)
        out[3, first + i] = (lens[0] * a + lens[1] * c) * length
        out[4, first + i] = (lens[0] * b + lens[1] * d) * length
    for i in range(n):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + 1)
        _, _, c, d = bend_slopes(x[i], y[i], lens)
        out[6, first + i], out[7, first + i] = lens[3] * c * length, lens[3] * d * length
    for i in range(n):
        out[5, first + i] = -(out[3, first + i] * x[i] + out[4, first + i] * y[i])
    for i in range(n):
        out[8, first + i] = -(out[6, first + i] * x[i] + out[7, first + i] * y[i])
