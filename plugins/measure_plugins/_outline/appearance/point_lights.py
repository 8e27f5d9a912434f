"""How a handful of lamps light a ball.

A lamp lights a surface by the cosine towards it, and not at all beyond its terminator. A polynomial
of the normal runs on there, past zero, just where a ball lit from above has its dark limb. What
enters a glossy surface slantwise is weakened as what leaves it is, so lamps set gradually.
Lamps are rows (k, 4): where one is in the camera frame, in mm, and its irradiance a metre away, in
any unit; seen from a ball, the unit direction towards it, and its irradiance there. They are near:
a terminator is elsewhere on each ball.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints, Singles
from measure.compiling import compiled, inlined
from measure.geometry.linear_kernels import cholesky, solve_factored
from measure_plugins._kernels.selection import SINGLES, nearly_kth, whole_vectors
from measure_plugins._outline.appearance.dichromatic import every_second
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

REFERENCE_MM = 1000.0
"""A lamp's irradiance is what it gives at this distance."""
_ROUNDS = 4
_COLUMNS = 5
_FITTED_RAYS = 36
"""Neighbouring rays show much the same: light is fitted to about so many of them."""
_LANES = 2 * _FITTED_RAYS
"""There are always fewer of them."""
_NOTHING = 1e-4
"""Share of a ball's own light below which a place along a ray lies past its blurred outline."""
_NONE, _ONE = np.float32(0), np.float32(1)
UNIFORM, FACING, ASIDE = 0, 1, 3
"""The columns of `radial.Radial.diffuse` for light that is even, or linear in the normal."""


def no_lamps() -> Floats:
    """None known (0, 4)."""
    return np.zeros((0, 4))


@compiled
def seen_from(lamps: Floats, frame: Floats, distance: float) -> Floats:
    """Lamps (k, 4) as a ball sees them, in the frame about its axis.

    Args:
        lamps: (k, 4) in the camera frame.
        frame: (3, 3) see `rays.frame_about`.
        distance: of the ball, mm.
    """
    out, way = np.empty_like(lamps), np.empty(3)
    for k in range(len(lamps)):
        for a in range(3):
            way[a] = lamps[k, a] - distance * frame[2, a]
        square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        per = 1 / np.sqrt(square)
        for a in range(3):
            out[k, a] = per * (frame[a, 0] * way[0] + frame[a, 1] * way[1] + frame[a, 2] * way[2])
        out[k, 3] = lamps[k, 3] * REFERENCE_MM**2 / square
    return out


@compiled
def lamp_light(diffuse: Floats, kept_out: float, around: Floats, lamps: Floats) -> Floats:
    """Light (m, n) the lamps draw from a ball, along its rays; empty (0, n) without lamps.

    Args:
        diffuse: (m, 6) see `radial.Radial`.
        kept_out: see `radial.Radial`.
        around: (n, 2) cosine and sine around the axis.
        lamps: (k, 4) seen from the ball.
    """
    n, out = len(around), np.zeros((len(diffuse) if len(lamps) > 0 else 0, len(around)))
    rows = 0
    for j in range(len(out)):
        if diffuse[j, UNIFORM] > _NOTHING:
            rows = j + 1
    # Places of all steps in a row: a lamp's loop over them is long enough to be quick.
    lanes = whole_vectors(rows * n, SINGLES)
    ahead, right = np.zeros(lanes, np.float32), np.zeros(lanes, np.float32)
    down, total = np.zeros(lanes, np.float32), np.zeros(lanes, np.float32)
    for j in range(rows):
        even = diffuse[j, UNIFORM]
        if even > _NOTHING:
            facing, aside = diffuse[j, FACING] / even, diffuse[j, ASIDE] / even
            for i in range(n):
                ahead[j * n + i] = -facing
                right[j * n + i] = aside * around[i, 0]
                down[j * n + i] = aside * around[i, 1]
    for k in range(len(lamps)):
        _add_light(lamps[k], kept_out, right, down, ahead, total)
    for j in range(rows):
        for i in range(n):
            out[j, i] = diffuse[j, UNIFORM] * total[j * n + i]
    return out


@inlined
def _add_light(
    lamp: Floats, kept_out: float, right: Singles, down: Singles, ahead: Singles, out: Singles
) -> None:
    """Add the light of a lamp (4,) to the sum (k,) of shares of what each place sends out.

    Args:
        lamp: seen from the ball.
        kept_out: see `radial.Radial`.
        right: (k,) how much of light along the first axis about the ball's a place sends out.
        down: (k,) the same of light along the second.
        ahead: (k,) the same of light from behind the ball, along its axis.
        out: changed.
    """
    x, y, z = np.float32(lamp[0]), np.float32(lamp[1]), np.float32(lamp[2])
    power, kept = np.float32(lamp[3]), np.float32(lamp[3] * kept_out)
    for i in range(len(out)):
        light = x * right[i] + y * down[i] + z * ahead[i]
        light = light if light > _NONE else _NONE
        slant = _ONE - light
        slant = slant if slant > _NONE else _NONE
        square = slant * slant
        out[i] += light * (power - kept * (square * square * slant))


@compiled
def fit_lamp_light(
    amounts: Floats, status: Statuses, around: Floats, diffuse: Floats, lit: Floats, used: int
) -> Floats:
    """Coefficients (5,) of lamps' light and of what is linear in the normal, robustly.

    Args:
        amounts: (m, n) of the ball's own colour.
        status: (n,) see `RaySet`.
        around: (n, 2) cosine and sine around the axis.
        diffuse: (m, 6) see `radial.Radial`.
        lit: (m, n) see `lamp_light`.
        used: how many steps to use, of which every second one is.

    Returns:
        Factors of even light, of that along the axis, of that along the other two, and of `lit`.
    """
    clear = some_clear(status)
    factors, angles = _factors(diffuse[:used:2]), around[clear]
    seen, bright = every_second(amounts, used, clear), every_second(lit, used, clear)
    coefficients, right = np.zeros(_COLUMNS), np.empty(_COLUMNS)
    factor, normal = np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS))
    per_limit = 0.0
    for turn in range(_ROUNDS):
        sums = _along_rays(seen, bright, factors, angles, coefficients, per_limit)
        _equations(sums, angles, normal, right)
        cholesky(normal, factor)
        solve_factored(factor, right, coefficients)
        if turn < _ROUNDS - 1:
            off = _typically_off(seen, bright, factors, angles, coefficients)
            per_limit = 1 / (5 * 1.4826 * off + 5e-4)
    return coefficients


@compiled
def some_clear(status: Statuses) -> Ints:
    """Of the rays with a clear way, those to which light is fitted (k,).

    Args:
        status: (n,) see `RaySet`.
    """
    return np.nonzero(status == CLEAR)[0][:: max(len(status) // _FITTED_RAYS, 1)]


@compiled
def _factors(diffuse: Floats) -> Floats:
    """Factors (3, p) of even light, of that along the axis and of that aside from it."""
    out = np.empty((3, len(diffuse)))
    for j in range(len(diffuse)):
        out[0, j], out[1, j] = diffuse[j, UNIFORM], diffuse[j, FACING]
        out[2, j] = diffuse[j, ASIDE]
    return out


@compiled
def _typically_off(
    seen: Floats, bright: Floats, factors: Floats, angles: Floats, coefficients: Floats
) -> float:
    """Median size of what the light fitted leaves, of every third pixel."""
    p, n = len(seen), len(angles)
    sizes, count = np.empty(-(-p * n // 3)), 0
    even, facing, x, y, power = coefficients
    for j in range(p):
        common, aside = even * factors[0, j] + facing * factors[1, j], factors[2, j]
        for i in range((-j * n) % 3, n, 3):
            sideways = x * angles[i, 0] + y * angles[i, 1]
            sizes[count] = abs(seen[j, i] - (common + aside * sideways + power * bright[j, i]))
            count += 1
    return nearly_kth(sizes, len(sizes) // 2)


@compiled
def _equations(sums: Floats, angles: Floats, normal: Floats, right: Floats) -> None:
    """Normal matrix (5, 5), its lower half, and right side (5,) from `_along_rays`' sums."""
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
def _along_rays(
    seen: Floats,
    bright: Floats,
    factors: Floats,
    angles: Floats,
    coefficients: Floats,
    per_limit: float,
) -> Floats:
    """Sums along each ray of what the equations are made of, up to the angles.

    Args:
        seen: (p, n) amounts of the ball's own colour, see `every_second`.
        bright: (p, n) light from the lamps there.
        factors: (3, p) of even light, of that along the axis and of that aside from it.
        angles: (k, 2) cosine and sine around the axis of the first k <= n of the rays.
        coefficients: (5,) about which Tukey's weights are taken.
        per_limit: 1 / where those end; 0 to take all alike.

    Returns:
        (14, _LANES), of whose columns the first k count: rows a constant distance apart are added
        to at once.
    """
    p, n = seen.shape
    sums, sideways = np.zeros((14, _LANES)), np.zeros(n)
    even_by, facing_by, x_by, y_by, power = coefficients
    for i in range(len(angles)):
        sideways[i] = x_by * angles[i, 0] + y_by * angles[i, 1]
    for j in range(p):
        even, facing, aside = factors[0, j], factors[1, j], factors[2, j]
        common = even_by * even + facing_by * facing
        for i in range(n):
            b, s = bright[j, i], seen[j, i]
            t = (s - (common + aside * sideways[i] + power * b)) * per_limit
            root = 1 - t * t
            root = root if root > 0.0 else 0.0
            w = root * root
            lit, shown = w * b, w * s
            sums[0, i] += even * even * w
            sums[1, i] += even * facing * w
            sums[2, i] += facing * facing * w
            sums[3, i] += even * aside * w
            sums[4, i] += facing * aside * w
            sums[5, i] += aside * aside * w
            sums[6, i] += even * lit
            sums[7, i] += facing * lit
            sums[8, i] += aside * lit
            sums[9, i] += b * lit
            sums[10, i] += even * shown
            sums[11, i] += facing * shown
            sums[12, i] += aside * shown
            sums[13, i] += b * shown
    return sums


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
