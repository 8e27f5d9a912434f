"""Diffuse shading of a ball: few functions of step and ray, fitted robustly to what is seen of it.

Where point lights are known, an even light, one linear in the normal, and the lights together: five
functions (formula 6). Elsewhere a quadratic polynomial of the normal: nine, each one of six radial
functions times an angular one (formula 7). See docs/explanation/outline.md.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.geometry.covariance import MAD_TO_SD
from measure.geometry.linear_kernels import cholesky, solve_factored
from measure_plugins._outline.sampling.rays import CLEAR, FITTED_RAYS, Statuses

UNIFORM, AXIAL, RADIAL = 0, 1, 3
"""Columns of `RadialTables.diffuse` for uniform light, and light linear in the normal."""
_LOBE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5])
"""Which radial function each of the nine angular terms goes with."""
REWEIGHTINGS = 4


@compiled
def some_clear(status: Statuses) -> Ints:
    """Indices (k,) of the clear rays, by the `status` (n,), to which light is fitted."""
    return np.nonzero(status == CLEAR)[0][:: max(len(status) // FITTED_RAYS, 1)]


@compiled
def shading_functions(around: Floats, diffuse: Floats, lighted: Floats) -> Floats:
    """What shading is a sum of: (t, m, n), of five terms or nine.

    Args:
        lighted: (m, n) see `shade_by_lights`; empty if no lights are known.
    """
    m, n, known = len(diffuse), len(around), lighted.size > 0
    out = np.empty((5 if known else 9, m, n))
    for i in range(n):
        x, y = around[i, 0], around[i, 1]
        if known:
            for j in range(m):
                out[0, j, i], out[1, j, i] = diffuse[j, UNIFORM], diffuse[j, AXIAL]
                out[2, j, i], out[3, j, i] = diffuse[j, RADIAL] * x, diffuse[j, RADIAL] * y
                out[4, j, i] = lighted[j, i]
            continue
        angular = (1.0, 1.0, 1.0, x, y, x, y, x * x - y * y, 2 * y * x)
        for k in range(9):
            for j in range(m):
                out[k, j, i] = diffuse[j, _LOBE[k]] * angular[k]
    return out


@compiled
def fit_shading(amounts: Floats, status: Statuses, functions: Floats, used: int) -> Floats:
    """Coefficients (t,) of `shading_functions`, by least squares with Tukey's weights.

    Args:
        amounts: (m, n) of the body colour.
        functions: (t, m, n).
        used: how many steps to use; every second one is.
    """
    rays, terms = some_clear(status), len(functions)
    coefficients, right = np.zeros(terms), np.empty(terms)
    if len(rays) == 0:
        return coefficients
    seen = _every_second(amounts, used, rays)
    design = np.empty((terms, len(seen)))
    for k in range(terms):
        design[k] = _every_second(functions[k], used, rays)
    weights, weighted = np.ones(len(seen)), np.empty(design.shape)
    factor = np.empty((terms, terms))
    for turn in range(REWEIGHTINGS):
        for k in range(terms):
            for i in range(len(seen)):
                weighted[k, i] = weights[i] * design[k, i]
        cholesky(np.dot(weighted, design.T) + 1e-3 * np.eye(terms), factor)
        right[:] = np.dot(weighted, seen)
        solve_factored(factor, right, coefficients)
        if turn < REWEIGHTINGS - 1:
            off = seen - np.dot(coefficients, design)
            sizes = np.abs(off[::3])
            typical = np.partition(sizes, len(sizes) // 2)[len(sizes) // 2]
            per_limit = 1 / (5 * MAD_TO_SD * typical + 5e-4)
            for i in range(len(seen)):
                root = max(1 - (off[i] * per_limit) ** 2, 0.0)
                weights[i] = root * root
    return coefficients


@compiled
def _every_second(values: Floats, used: int, rays: Ints) -> Floats:
    """Every second of the first `used` rows of (m, n), on the rays (k,), one after the other."""
    return values[:used:2][:, rays].reshape(-1)


@compiled
def shaded(coefficients: Floats, functions: Floats) -> Floats:
    """Diffuse light (m, n) by coefficients (t,) of functions (t, m, n)."""
    out = coefficients[0] * functions[0]
    for k in range(1, len(coefficients)):
        out += coefficients[k] * functions[k]
    return out
