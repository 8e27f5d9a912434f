"""The cone through outline points, robustly: random sample consensus, then Tukey weights.

About a predicted cone, a turn of its axis by (d1, d2) and a change of its half angle by da move the
outline, along its normal, by `scale * (cos(phi) d1 + sin(phi) d2 + da)`: linear in three unknowns.
See docs/explanation/outline.md, formula 15.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.covariance import MAD_TO_SD, TUKEY_SIGMAS
from measure.geometry.linear_kernels import cholesky, solve_factored

_ITERATIONS, _CONVERGED_PX = 6, 1e-3
_MIN_POINTS = 4
MAX_RESIDUAL_PX = 1.6
"""Points with larger residuals are left out, whatever the scatter of the others."""


@compiled
def consensus(shifts: Floats, around: Floats, use: Floats, gate_px: float, trials: int) -> Floats:
    """The three-point solution most points agree with.

    Args:
        shifts: (n,) outline shifts along the normals, px.
        use: (n,) 1 for points to use, else 0.
        gate_px: how near a point must be to agree.
        trials: number of triples; a fixed sequence, so that results repeat.

    Returns:
        (3,) shift in px of the axis along e1 and e2, and growth of the radius.
    """
    index = np.nonzero(use)[0]
    at, cosine, sine = shifts[index], around[index, 0], around[index, 1]
    found, score = _three_point_solutions(at, cosine, sine, trials)
    per_gate = 1 / gate_px
    # Trials in the inner loop, which is vectorised; each one's sum is in the points' order.
    for j in range(len(at)):
        for t in range(len(score)):
            r = (at[j] - (cosine[j] * found[0, t] + sine[j] * found[1, t] + found[2, t])) * per_gate
            near = 1 - r * r
            score[t] += near if near > 0.0 else 0.0
    best, out = -1.0, np.zeros(3)
    for t in range(trials):
        if score[t] > best:
            best = score[t]
            out[:] = found[:, t]
    return out


@compiled
def _three_point_solutions(
    at: Floats, cosine: Floats, sine: Floats, trials: int
) -> tuple[Floats, Floats]:
    """Solutions (3, k) through k triples of points (n,); scores (k,), -inf without a solution."""
    found, score = np.zeros((3, trials)), np.full(trials, -np.inf)
    state, n = np.uint64(12345), np.uint32(len(at))
    pick = np.zeros(3, np.uint64)
    for t in range(trials):
        for k in range(3):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            pick[k] = np.uint32(state >> np.uint64(33)) % n
        a, b, p = cosine[pick[0]], sine[pick[0]], at[pick[0]]
        d, e, q = cosine[pick[1]], sine[pick[1]], at[pick[1]]
        g, h, r = cosine[pick[2]], sine[pick[2]], at[pick[2]]
        det = a * (e - h) - b * (d - g) + (d * h - e * g)
        if abs(det) < 1e-3:
            continue
        score[t], per = 0.0, 1 / det
        found[0, t] = per * (p * (e - h) - b * (q - r) + (q * h - e * r))
        found[1, t] = per * (a * (q - r) - p * (d - g) + (d * r - q * g))
        found[2, t] = per * (a * (e * r - q * h) - b * (d * r - q * g) + p * (d * h - e * g))
    return found, score


@compiled
def refine(
    shifts: Floats,
    around: Floats,
    sd: Floats,
    use: Floats,
    start: Floats,
    gate_px: float,
    growth: tuple[float, float],
) -> tuple[Floats, Floats, Floats, float]:
    """Iterated Tukey-weighted least squares from `start`; `shifts` and `use` as in `consensus`.

    Args:
        sd: (n,) standard deviations of the shifts, px.
        start: (3,) to start from.
        gate_px: how near a point must be at first.
        growth: prior mean and sd of the growth, px.

    Returns:
        Solution (3,) as in `consensus`, normal matrix (3, 3) of the weighted fit in px^-2, the
        points' final robust weights (n,), and the residuals' robust scale in units of `sd`.
    """
    solution, weights = start.copy(), use.copy()
    normal, right, scale = np.zeros((3, 3)), np.empty(3), 1.0
    factor, nothing = np.empty((3, 3)), np.zeros(len(shifts))
    off, scratch = np.empty(len(shifts)), np.empty(len(shifts))
    for turn in range(_ITERATIONS):
        d1, d2, growing = solution
        for i in range(len(shifts)):
            off[i] = shifts[i] - (around[i, 0] * d1 + around[i, 1] * d2 + growing)
        trusted, gate = (use, gate_px) if turn == 0 else (weights, np.inf)
        scale = _scatter(off, sd, trusted, gate)
        if not np.isfinite(scale):
            return solution, normal, nothing, np.inf
        _weigh(off, sd, use, scale, weights)
        per_scale = 1 / (scale * scale)
        for i in range(len(shifts)):
            scratch[i] = weights[i] * per_scale / (sd[i] * sd[i])
        _equations(shifts, around, scratch, growth, normal, right)
        if not cholesky(normal, factor):
            return solution, normal, nothing, np.inf
        det = (factor[0, 0] * factor[1, 1] * factor[2, 2]) ** 2
        if not det > 1e-7 * normal[2, 2] ** 3:
            return solution, normal, nothing, np.inf
        solve_factored(factor, right, solution)
        change = max(abs(solution[0] - d1), abs(solution[1] - d2), abs(solution[2] - growing))
        if change < _CONVERGED_PX:
            break
    return solution, normal, weights, scale


@compiled
def _scatter(off: Floats, sd: Floats, use: Floats, gate_px: float) -> float:
    """Robust scale of the residuals in use, in units of `sd`; infinite if there are too few."""
    used = (use > 0) & (np.abs(off) < gate_px)
    count = np.count_nonzero(used)
    if count < _MIN_POINTS:
        return np.inf
    return max(MAD_TO_SD * np.partition(np.abs(off[used]) / sd[used], count // 2)[count // 2], 0.3)


@compiled
def _weigh(off: Floats, sd: Floats, use: Floats, scale: float, weights: Floats) -> None:
    """Tukey's weights of residuals (n,) of those points that are to be used."""
    for i in range(len(off)):  # without branches, so that the loop is vectorised
        limit = sd[i] * scale * TUKEY_SIGMAS
        t = off[i] / (limit if limit < MAX_RESIDUAL_PX else MAX_RESIDUAL_PX)
        root = 1 - t * t
        weights[i] = root * root if (root > 0.0) & (use[i] > 0) else 0.0


@compiled
def _equations(
    shifts: Floats,
    around: Floats,
    weights: Floats,
    growth: tuple[float, float],
    normal: Floats,
    right: Floats,
) -> None:
    """Normal matrix (3, 3) and right side (3,) of the weighted fit and the prior of the growth."""
    xx, xy, yy, x1, y1, xs, ys = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mass, shift = 1 / growth[1] ** 2, growth[0] / growth[1] ** 2
    for i in range(len(shifts)):
        w = weights[i]
        if w > 0:
            x, y = around[i, 0], around[i, 1]
            wx, wy, ws = w * x, w * y, w * shifts[i]
            xx, xy, yy = xx + wx * x, xy + wx * y, yy + wy * y
            x1, y1, mass = x1 + wx, y1 + wy, mass + w
            xs, ys, shift = xs + x * ws, ys + y * ws, shift + ws
    normal[0, 0], normal[1, 1], normal[2, 2] = xx, yy, mass
    normal[1, 0], normal[2, 0], normal[2, 1] = xy, x1, y1
    normal[0, 1], normal[0, 2], normal[1, 2] = xy, x1, y1
    right[0], right[1], right[2] = xs, ys, shift
