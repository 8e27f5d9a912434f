"""Residuals of a predicted picture, its outline moved to where it fits best.

See docs/explanation/outline.md, formula 18.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

_ITERATIONS = 3
_TYPICAL = 3.0
"""Mean square of a ray's residuals, per median of all rays, at which its weight falls to a
quarter."""


@compiled
def aligned_residuals(
    seen: Floats,
    predicted: Floats,
    status: Statuses,
    around: Floats,
    compared: int,
    step_px: float,
    weights: Floats,
) -> tuple[Floats, Floats]:
    """Picture minus prediction, after the best shift and growth of the outline.

    Args:
        seen: (3, m, n) picture values along n rays.
        predicted: (3, m, n) the same as predicted.
        status: (n,) see `RaySet`; the k clear rays are compared.
        around: (n, 2) cosine and sine around the axis.
        compared: how many of the m samples count, from the inside.
        weights: (k,) of the rays; if empty, robust ones are computed.

    Returns:
        Residuals (k, 3 compared), and the weights (k,).
    """
    rays = np.flatnonzero(status == CLEAR)
    left, slopes = _off(seen, predicted, rays, compared, step_px)
    sums, where, moved = _sums(left, slopes), around[rays], np.empty(left.shape)
    if len(weights) > 0:
        _move(left, slopes, _shifts(sums, where, weights), moved)
        return moved, weights
    robust, power = np.ones(len(rays)), np.empty(len(rays))
    for _ in range(_ITERATIONS):
        _move(left, slopes, _shifts(sums, where, robust), moved)
        for i in range(len(rays)):
            total = 0.0
            for j in range(left.shape[1]):
                total += moved[i, j] * moved[i, j]
            power[i] = total / left.shape[1]
        typical = _TYPICAL * np.median(power) + 1e-9
        robust = 1 / (1 + power / typical) ** 2
    return moved, robust


@compiled
def _off(
    seen: Floats, predicted: Floats, rays: Ints, compared: int, step_px: float
) -> tuple[Floats, Floats]:
    """Seen minus predicted, and its derivative by an outward shift, both ray by ray."""
    m = predicted.shape[1]
    left, slopes = np.empty((len(rays), 3 * compared)), np.empty((len(rays), 3 * compared))
    for k, i in enumerate(rays):
        for c in range(3):
            for j in range(compared):
                low, high = max(j - 1, 0), min(j + 1, m - 1)
                rise = predicted[c, high, i] - predicted[c, low, i]
                left[k, c * compared + j] = seen[c, j, i] - predicted[c, j, i]
                slopes[k, c * compared + j] = -rise / ((high - low) * step_px)
    return left, slopes


@compiled
def _sums(left: Floats, slopes: Floats) -> Floats:
    """Sums (2, k) along each ray of squared slopes, and of slopes times residuals."""
    out = np.zeros((2, len(left)))
    for i in range(len(left)):
        for j in range(left.shape[1]):
            out[0, i] += slopes[i, j] * slopes[i, j]
            out[1, i] += slopes[i, j] * left[i, j]
    return out


@compiled
def _shifts(sums: Floats, around: Floats, weights: Floats) -> Floats:
    """Displacement (k,) of the outline in px along each ray, by its best shift and growth.

    Args:
        sums: (2, k) see `_sums`.
        around: (k, 2) cosine and sine around the axis.
        weights: (k,) of the rays.
    """
    normal, right, design = 1e-9 * np.eye(3), np.zeros(3), np.ones(3)
    for i in range(len(around)):
        design[0], design[1] = around[i, 0], around[i, 1]
        square, toward = weights[i] * sums[0, i], weights[i] * sums[1, i]
        for a in range(3):
            right[a] += design[a] * toward
            for b in range(3):
                normal[a, b] += design[a] * design[b] * square
    x, y, growth = np.linalg.solve(normal, right)
    out = np.empty(len(around))
    for i in range(len(around)):
        out[i] = x * around[i, 0] + y * around[i, 1] + growth
    return out


@compiled
def _move(left: Floats, slopes: Floats, shifts: Floats, out: Floats) -> None:
    """Fill the residuals (k, m) that are left when the outline moves by shifts (k,)."""
    for i in range(len(left)):
        for j in range(left.shape[1]):
            out[i, j] = left[i, j] - slopes[i, j] * shifts[i]
