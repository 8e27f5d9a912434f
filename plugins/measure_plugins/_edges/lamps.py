"""How a handful of lamps light a ball.

A lamp lights a surface by the cosine towards it, and not at all beyond its terminator. A polynomial
of the normal runs on there, past zero, just where a ball lit from above has its dark limb.
Lamps are rows (k, 4): the unit direction towards one, and its irradiance in any unit.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._edges.linear import cholesky, solve_factored
from measure_plugins._edges.selection import kth_smallest

_ROUNDS = 4
_COLUMNS = 5
_NOTHING = 1e-4
"""Share of a ball's own light below which a place along a ray lies past its blurred outline."""
UNIFORM, FACING, ASIDE = 0, 1, 3
"""The columns of `radial.Radial.diffuse` for light that is even, or linear in the normal."""


def no_lamps() -> Floats:
    """None known (0, 4)."""
    return np.zeros((0, 4))


@compiled
def seen_from(lamps: Floats, frame: Floats) -> Floats:
    """Lamps (k, 4) in the frame (3, 3) about an axis, see `rays.frame_about`."""
    out = lamps.copy()
    for k in range(len(lamps)):
        for a in range(3):
            out[k, a] = (
                frame[a, 0] * lamps[k, 0] + frame[a, 1] * lamps[k, 1] + frame[a, 2] * lamps[k, 2]
            )
    return out


@compiled
def lamp_light(diffuse: Floats, around: Floats, lamps: Floats) -> Floats:
    """Light (m, n) the lamps draw from a ball, along its rays.

    Args:
        diffuse: (m, 6) see `radial.Radial`.
        around: (n, 2) cosine and sine around the axis.
        lamps: (k, 4) in the frame about the axis.
    """
    m, n = len(diffuse), len(around)
    out, sideways = np.zeros((m, n)), np.empty(n)
    for k in range(len(lamps)):
        x, y, z, power = lamps[k]
        for i in range(n):
            sideways[i] = power * (around[i, 0] * x + around[i, 1] * y)
        for j in range(m):
            facing, aside = -power * z * diffuse[j, FACING], diffuse[j, ASIDE]
            if diffuse[j, UNIFORM] > _NOTHING:
                for i in range(n):
                    out[j, i] += max(facing + aside * sideways[i], 0.0)
    return out


@compiled
def fit_lamp_light(
    amounts: Floats, free: Floats, around: Floats, diffuse: Floats, lit: Floats, used: int
) -> Floats:
    """Coefficients (5,) of lamps' light and of what is linear in the normal, robustly.

    Args:
        amounts: (m, n) of the ball's own colour.
        free: (n,) 0 for rays with a clear way.
        around: (n, 2) cosine and sine around the axis.
        diffuse: (m, 6) see `radial.Radial`.
        lit: (m, n) see `lamp_light`.
        used: how many steps to use, of which every second one is.

    Returns:
        Factors of even light, of that along the axis, of that along the other two, and of `lit`.
    """
    columns, seen = _columns(amounts, free, around, diffuse, lit, used)
    coefficients, right = np.zeros(_COLUMNS), np.empty(_COLUMNS)
    factor, normal = np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS))
    off, limit = seen, np.inf
    for turn in range(_ROUNDS):
        weighted = np.empty(columns.shape)
        for i in range(len(seen)):
            t = off[i] / limit
            w = max(1 - t * t, 0.0)
            for a in range(_COLUMNS):
                weighted[a, i] = w * w * columns[a, i]
        normal[:] = weighted @ columns.T + 1e-3 * np.eye(_COLUMNS)
        right[:] = weighted @ seen
        cholesky(normal, factor)
        solve_factored(factor, right, coefficients)
        if turn < _ROUNDS - 1:
            off = seen - coefficients @ columns
            sizes = np.abs(off[::3])
            limit = 5 * 1.4826 * kth_smallest(sizes, len(sizes), len(sizes) // 2) + 5e-4
    return coefficients


@compiled
def _columns(
    amounts: Floats, free: Floats, around: Floats, diffuse: Floats, lit: Floats, used: int
) -> tuple[Floats, Floats]:
    """What the coefficients multiply (5, p), and the amounts (p,), at the pixels used."""
    clear = np.nonzero(free == 0)[0]
    count = (used + 1) // 2 * len(clear)
    columns, seen = np.empty((_COLUMNS, count)), np.empty(count)
    at = 0
    for j in range(0, used, 2):
        even, facing, aside = diffuse[j, UNIFORM], diffuse[j, FACING], diffuse[j, ASIDE]
        for i in clear:
            columns[0, at], columns[1, at] = even, facing
            columns[2, at], columns[3, at] = aside * around[i, 0], aside * around[i, 1]
            columns[4, at] = lit[j, i]
            seen[at] = amounts[j, i]
            at += 1
    return columns, seen


@compiled
def lamp_body(
    coefficients: Floats, around: Floats, diffuse: Floats, lit: Floats, first: int
) -> Floats:
    """The ball's own light (m - first, n) by the coefficients of `fit_lamp_light`."""
    out = np.empty((len(diffuse) - first, len(around)))
    even, facing, x, y, power = coefficients
    for j in range(first, len(diffuse)):
        common = even * diffuse[j, UNIFORM] + facing * diffuse[j, FACING]
        for i in range(len(around)):
            aside = x * around[i, 0] + y * around[i, 1]
            out[j - first, i] = common + diffuse[j, ASIDE] * aside + power * lit[j, i]
    return out
