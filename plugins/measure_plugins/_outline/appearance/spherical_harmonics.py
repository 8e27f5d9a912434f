"""Quadratic shading of the diffuse light, where no point lights are known (see `radial_basis`).

Nine coefficients, each of one of six radial functions times an angular one.
See docs/explanation/outline.md, formula 7.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.covariance import MAD_TO_SD
from measure.geometry.linear_kernels import cholesky, solve_factored
from measure_plugins._outline.appearance.dichromatic import every_second
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

LOBE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5])
"""Which radial function each of the nine angular terms goes with."""
_LOBES = 6
_TERMS = len(LOBE)
_PAIR = np.array(
    [LOBE[a] * (LOBE[a] + 1) // 2 + LOBE[b] for a in range(_TERMS) for b in range(a + 1)]
)
"""Which product of two radial functions, see `_pairs`, each entry of the normal matrix has."""
_ITERATIONS = 4


@compiled
def angular_terms(around: Floats) -> Floats:
    """The nine angular functions (9, n) at cosine and sine around the axis (n, 2)."""
    n = len(around)
    out = np.ones((9, n))
    for i in range(n):
        cosine, sine = around[i, 0], around[i, 1]
        out[3, i], out[4, i] = cosine, sine
        out[5, i], out[6, i] = cosine, sine
        out[7, i], out[8, i] = cosine * cosine - sine * sine, 2 * sine * cosine
    return out


@compiled
def radial_amounts(coefficients: Floats, angular: Floats) -> Floats:
    """Amounts (6, n) of the radial functions on every ray."""
    out = np.zeros((_LOBES, angular.shape[1]))
    for k in range(_TERMS):
        for i in range(angular.shape[1]):
            out[LOBE[k], i] += coefficients[k] * angular[k, i]
    return out


@compiled
def shaded(coefficients: Floats, angular: Floats, lobes: Floats) -> Floats:
    """Diffuse light (m, n) at angular functions (9, n) and radial ones (m, 6)."""
    return np.dot(lobes, radial_amounts(coefficients, angular))


@compiled
def fit_shading(
    amounts: Floats, status: Statuses, angular: Floats, lobes: Floats, used: int
) -> Floats:
    """Coefficients (9,) of quadratic shading, robustly.

    Args:
        amounts: (m, n) of the body colour.
        status: (n,) see `RaySet`.
        angular: (9, n).
        lobes: (m, 6) the radial functions.
        used: number of steps, of which every second one is used.
    """
    clear = np.nonzero(status == CLEAR)[0]
    if len(clear) == 0:
        return np.zeros(_TERMS)
    seen, radial = every_second(amounts, used, clear), lobes[:used:2].copy()
    around = angular[:, clear]
    products, angular_products = _pairs(radial.T), _pairs(around)
    coefficients, right = np.zeros(_TERMS), np.empty(_TERMS)
    factor, normal = np.empty((_TERMS, _TERMS)), np.empty((_TERMS, _TERMS))
    shown, per_limit = np.zeros(seen.shape), 0.0
    for turn in range(_ITERATIONS):
        weights, weighted = _weighted(seen, shown, per_limit)
        sums, sides = np.dot(products, weights), np.dot(radial.T, weighted)
        _equations(sums, sides, around, angular_products, normal, right)
        cholesky(normal, factor)
        solve_factored(factor, right, coefficients)
        if turn < _ITERATIONS - 1:
            shown = shaded(coefficients, around, radial)
            sizes = np.abs(seen[::3] - shown[::3]).reshape(-1)
            off = np.partition(sizes, len(sizes) // 2)[len(sizes) // 2]
            per_limit = 1 / (5 * MAD_TO_SD * off + 5e-4)
    return coefficients


@compiled
def _pairs(rows: Floats) -> Floats:
    """Products (k (k + 1) / 2, n) of every row of (k, n) with those up to itself."""
    k, n = rows.shape
    out = np.empty((k * (k + 1) // 2, n))
    at = 0
    for a in range(k):
        for b in range(a + 1):
            for i in range(n):
                out[at, i] = rows[a, i] * rows[b, i]
            at += 1
    return out


@compiled
def _weighted(seen: Floats, shown: Floats, per_limit: float) -> tuple[Floats, Floats]:
    """Tukey's weights (p, n), and weights times `seen`; `per_limit` is 1 / limit, or 0."""
    p, n = seen.shape
    weights, weighted = np.empty((p, n)), np.empty((p, n))
    for j in range(p):
        for i in range(n):
            t = (seen[j, i] - shown[j, i]) * per_limit
            root = 1 - t * t
            root = root if root > 0.0 else 0.0
            weights[j, i] = root * root
            weighted[j, i] = root * root * seen[j, i]
    return weights, weighted


@compiled
def _equations(
    sums: Floats,
    sides: Floats,
    around: Floats,
    angular_products: Floats,
    normal: Floats,
    right: Floats,
) -> None:
    """Normal matrix (9, 9), its lower half, and right side (9,) of the weighted fit.

    Args:
        sums: (21, n) along each ray, weights times products of radial functions.
        sides: (6, n) along each ray, weighted amounts times radial functions.
        around: (9, n) angular functions.
        angular_products: (45, n) of them.
        normal: filled.
        right: filled.
    """
    at = 0
    for a in range(_TERMS):
        right[a] = np.dot(sides[LOBE[a]], around[a])
        for b in range(a + 1):
            normal[a, b] = np.dot(sums[_PAIR[at]], angular_products[at])
            at += 1
        normal[a, a] += 1e-3
