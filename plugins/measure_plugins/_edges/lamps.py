"""How a handful of lamps light a ball.

A lamp lights a surface by the cosine towards it, and not at all beyond its terminator. A polynomial
of the normal runs on there, past zero, just where a ball lit from above has its dark limb.
Lamps are rows (k, 4): the unit direction towards one, and its irradiance in any unit.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure_plugins._edges.linear import cholesky, solve_factored, times
from measure_plugins._edges.selection import kth_smallest

_ROUNDS = 4
_COLUMNS = 5
_FITTED_RAYS = 36
"""Neighbouring rays show much the same: light is fitted to about so many of them."""
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
    """Light (m, n) the lamps draw from a ball, along its rays; empty (0, n) without lamps.

    Args:
        diffuse: (m, 6) see `radial.Radial`.
        around: (n, 2) cosine and sine around the axis.
        lamps: (k, 4) in the frame about the axis.
    """
    m, n = len(diffuse), len(around)
    out, sideways = np.zeros((m if len(lamps) > 0 else 0, n)), np.empty(n)
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
    clear = np.nonzero(free == 0)[0][:: max(len(free) // _FITTED_RAYS, 1)]
    factors, angles = _factors(diffuse[:used:2]), around[clear]
    seen, bright = _every_second(amounts, used, clear), _every_second(lit, used, clear)
    coefficients, right = np.zeros(_COLUMNS), np.empty(_COLUMNS)
    factor, normal = np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS))
    weights = np.ones(seen.shape)
    for turn in range(_ROUNDS):
        _equations(weights, seen, bright, factors, angles, normal, right)
        cholesky(normal, factor)
        solve_factored(factor, right, coefficients)
        if turn < _ROUNDS - 1:
            shown = _light(coefficients, angles, factors, bright)
            _weigh(seen.reshape(-1), shown.reshape(-1), weights.reshape(-1))
    return coefficients


@compiled
def _factors(diffuse: Floats) -> Floats:
    """Factors (3, p) of even light, of that along the axis and of that aside from it."""
    out = np.empty((3, len(diffuse)))
    for j in range(len(diffuse)):
        out[0, j], out[1, j] = diffuse[j, UNIFORM], diffuse[j, FACING]
        out[2, j] = diffuse[j, ASIDE]
    return out


@compiled
def _every_second(values: Floats, used: int, rays: Ints) -> Floats:
    """Every second of the first `used` rows of (m, n), on the rays (k,): (p, k)."""
    out = np.empty(((used + 1) // 2, len(rays)))
    for j in range(len(out)):
        for k in range(len(rays)):
            out[j, k] = values[2 * j, rays[k]]
    return out


@compiled
def _weigh(seen: Floats, shown: Floats, weights: Floats) -> None:
    """Tukey's weights (k,) of what is seen, by how far it is from what is shown."""
    sizes = np.empty((len(seen) + 2) // 3)
    for k in range(len(sizes)):
        sizes[k] = abs(seen[3 * k] - shown[3 * k])
    limit = 5 * 1.4826 * kth_smallest(sizes, len(sizes), len(sizes) // 2) + 5e-4
    for k in range(len(seen)):
        t = (seen[k] - shown[k]) / limit
        w = 1 - t * t
        w = w if w > 0.0 else 0.0
        weights[k] = w * w


@compiled
def _equations(
    weights: Floats,
    seen: Floats,
    bright: Floats,
    factors: Floats,
    angles: Floats,
    normal: Floats,
    right: Floats,
) -> None:
    """Normal matrix (5, 5), its lower half, and right side (5,): along each ray, then over rays.

    Args:
        weights: (p, n) of the pixels used.
        seen: (p, n) their amounts of the ball's own colour.
        bright: (p, n) their light from the lamps.
        factors: (3, p) of even light, of that along the axis and of that aside from it.
        angles: (n, 2) cosine and sine around the axis.
        normal: filled.
        right: filled.
    """
    sums = _along_rays(weights, seen, bright, factors)
    normal[:], right[:] = 1e-3 * np.eye(_COLUMNS), 0.0
    for i in range(len(angles)):
        x, y = angles[i]
        normal[0, 0] += sums[0, i]
        normal[1, 0] += sums[1, i]
        normal[1, 1] += sums[2, i]
        normal[2, 0] += x * sums[3, i]
        normal[2, 1] += x * sums[4, i]
        normal[2, 2] += x * x * sums[5, i]
        normal[3, 0] += y * sums[3, i]
        normal[3, 1] += y * sums[4, i]
        normal[3, 2] += y * x * sums[5, i]
        normal[3, 3] += y * y * sums[5, i]
        normal[4, 0] += sums[6, i]
        normal[4, 1] += sums[7, i]
        normal[4, 2] += x * sums[8, i]
        normal[4, 3] += y * sums[8, i]
        normal[4, 4] += sums[9, i]
        right[0] += sums[10, i]
        right[1] += sums[11, i]
        right[2] += x * sums[12, i]
        right[3] += y * sums[12, i]
        right[4] += sums[13, i]


@compiled
def _along_rays(weights: Floats, seen: Floats, bright: Floats, factors: Floats) -> Floats:
    """Sums (14, n) along each ray of what the equations are made of, up to the angles."""
    p, n = weights.shape
    out, products = np.zeros((14, n)), np.empty((6, p))
    lit, shown = np.empty((p, n)), np.empty((p, n))
    for j in range(p):
        even, facing, aside = factors[0, j], factors[1, j], factors[2, j]
        products[0, j], products[1, j], products[2, j] = even * even, even * facing, facing * facing
        products[3, j], products[4, j], products[5, j] = even * aside, facing * aside, aside * aside
        for i in range(n):
            w, b, s = weights[j, i], bright[j, i], seen[j, i]
            lit[j, i], shown[j, i] = w * b, w * s
            out[9, i] += w * b * b
            out[13, i] += w * s * b
    times(products, weights, out[:6])
    times(factors, lit, out[6:9])
    times(factors, shown, out[10:13])
    return out


@compiled
def lamp_body(
    coefficients: Floats, around: Floats, diffuse: Floats, lit: Floats, first: int
) -> Floats:
    """The ball's own light (m - first, n) by the coefficients of `fit_lamp_light`."""
    return _light(coefficients, around, _factors(diffuse[first:]), lit[first:])


@compiled
def _light(coefficients: Floats, angles: Floats, factors: Floats, bright: Floats) -> Floats:
    """The ball's own light (p, n) where lamps give it `bright`; arguments as in `_equations`."""
    even, facing, x, y, power = coefficients
    out, sideways = np.empty(bright.shape), np.empty(len(angles))
    for i in range(len(angles)):
        sideways[i] = x * angles[i, 0] + y * angles[i, 1]
    for j in range(len(bright)):
        common, aside = even * factors[0, j] + facing * factors[1, j], factors[2, j]
        for i in range(len(angles)):
            out[j, i] = common + aside * sideways[i] + power * bright[j, i]
    return out
