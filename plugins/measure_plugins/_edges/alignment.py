"""What a prediction leaves of a picture, its outline moved to where it fits best."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure_plugins._edges.rays import FREE
from measure_plugins._edges.selection import median

_ROUNDS = 3
_TYPICAL = 3.0
"""Rays that are this many times as far off as the median, squared, lose most of their weight."""


@compiled
def aligned_residuals(
    seen: Floats,
    predicted: Floats,
    free: Floats,
    around: Floats,
    compared: int,
    step_px: float,
    weights: Floats,
) -> tuple[Floats, Floats]:
    """Picture minus prediction, less the best shift and growth of the outline.

    Args:
        seen: (3, m, n) picture values along n rays.
        predicted: (3, m, n) the same as predicted.
        free: (n,) `rays.FREE` for the k rays to compare.
        around: (n, 2) cosine and sine around the axis.
        compared: how many of the m samples count, from the inside.
        step_px: their distance.
        weights: (k,) of the rays; empty, they are made robust.

    Returns:
        (k, 3 compared) what is left, and the weights (k,).
    """
    rays = np.flatnonzero(free == FREE)
    left, slopes = _off(seen, predicted, rays, compared, step_px)
    if len(weights) > 0:
        return left - slopes * _shifts(left, slopes, around[rays], weights), weights
    robust, moved = np.ones(len(rays)), left
    for _ in range(_ROUNDS):
        moved = left - slopes * _shifts(left, slopes, around[rays], robust)
        power = np.empty(len(rays))
        for i in range(len(rays)):
            power[i] = np.mean(moved[i] ** 2)
        typical = _TYPICAL * median(power.copy(), len(power)) + 1e-9
        robust = 1 / (1 + power / typical) ** 2
    return moved, robust


@compiled
def _off(
    seen: Floats, predicted: Floats, rays: Ints, compared: int, step_px: float
) -> tuple[Floats, Floats]:
    """Seen minus predicted, and how that changes as the outline moves outward, both ray by ray."""
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
def _shifts(left: Floats, slopes: Floats, around: Floats, weights: Floats) -> Floats:
    """How far (k, 1), in px, the outline is off along each ray: a shift of it, and growth."""
    normal, right, design = 1e-9 * np.eye(3), np.zeros(3), np.ones(3)
    for i in range(len(left)):
        design[:2] = around[i]
        square = weights[i] * np.sum(slopes[i] * slopes[i])
        toward = weights[i] * np.sum(slopes[i] * left[i])
        for a in range(3):
            right[a] += design[a] * toward
            for b in range(3):
                normal[a, b] += design[a] * design[b] * square
    x, y, growth = np.linalg.solve(normal, right)
    out = np.empty((len(left), 1))
    for i in range(len(left)):
        out[i, 0] = x * around[i, 0] + y * around[i, 1] + growth
    return out
