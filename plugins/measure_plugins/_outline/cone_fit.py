"""The cone through the edges of an outline, and the covariance of its centre in the picture.

The cone is fitted robustly: random sample consensus, then Tukey weights. About a predicted cone, a
turn of its axis by (d1, d2) and a change of its half angle by da move the outline, along its
normal, by `scale * (cos(phi) d1 + sin(phi) d2 + da)`: linear in three unknowns. The covariance
comes from how edges scatter about it. See docs/explanation/outline.md, formulas 15 and 17.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.covariance import MAD_TO_SD, TUKEY_SIGMAS
from measure.geometry.kernels import cholesky, inverse, solve_factored
from measure.model.lens import to_pixel

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


_BLOCKS = 12
_WAVES = 12
_STEEPNESS = 1.5
"""The power of the k-th wave of an outline's errors is taken as k to the minus this: so fall, in
the mean of seventeen rendered recordings, the residuals' waves from the second to the fifth."""
_POWERS = np.repeat(np.maximum(np.arange(_WAVES + 1.0), 1) ** -_STEEPNESS, 2)
_ARCS = 24  # Arcs of the outline, whose means are nearly without noise


@compiled
def image_directions(frame: Floats, lens: Floats) -> Floats:
    """Image (2, 2) of a turn by one radian of the axis along e1 and e2: columns in px."""
    h = 1e-6
    out = np.empty((2, 2))
    for k in range(2):
        a, b = frame[2] + h * frame[k], frame[2] - h * frame[k]
        u1, v1 = to_pixel(a[0], a[1], a[2], lens)
        u2, v2 = to_pixel(b[0], b[1], b[2], lens)
        out[0, k], out[1, k] = (u1 - u2) / (2 * h), (v1 - v2) / (2 * h)
    return out


@compiled
def center_covariance(around: Floats, weights: Floats, off: Floats, normal: Floats) -> Floats:
    """Covariance (2, 2) of a cone's axis along e1 and e2, px^2, by its edges (formula 17).

    Shading, reflections and background shift edges alike over arcs of any length. Errors that
    shift one half of the outline out and the other in move the centre and leave no residual; their
    size is inferred from shorter waves, which leave some. The covariance is that of independent
    edges plus the fit's response to all waves, scaled to the scatter of the arcs' means.

    Args:
        around: (n, 2) cosine and sine of evenly spaced rays around the axis.
        weights: (n,) of the edges in the fit, px^-2; 0 for rays left out.
        off: (n,) the edges' residuals, px.
        normal: (3, 3) of the fit: axis along e1 and e2, growth.
    """
    known, n = inverse(normal), len(off)
    design, waves = _design(around), _waves(around)
    responses = known @ np.dot(design * weights, waves.T)
    left = (waves - np.dot(responses.T, design)) * weights
    seen, unexplained = 0.0, 0.0
    for arc in range(_ARCS):
        first, last = arc * n // _ARCS, (arc + 1) * n // _ARCS
        mass = np.sum(weights[first:last])
        if mass > 0:
            seen += np.sum(weights[first:last] * off[first:last]) ** 2 / mass
            for k in range(len(waves)):
                unexplained += _POWERS[k] * np.sum(left[k, first:last]) ** 2 / mass
    by_axis = responses[:2].copy()
    return np.dot(by_axis * _POWERS, by_axis.T) * (seen / unexplained) + known[:2, :2]


@compiled
def _design(around: Floats) -> Floats:
    """How far (3, n) edges move by a step of the axis along e1 and e2, and by growth."""
    out = np.ones((3, len(around)))
    out[0], out[1] = around[:, 0], around[:, 1]
    return out


@compiled
def _waves(around: Floats) -> Floats:
    """Cosines and sines (2 w, n) of waves round an outline, the first of them constant."""
    out, (x, y) = np.zeros((2 * (_WAVES + 1), len(around))), (around[:, 0], around[:, 1])
    out[0] = 1.0
    for k in range(2, len(out), 2):
        out[k] = x * out[k - 2] - y * out[k - 1]
        out[k + 1] = y * out[k - 2] + x * out[k - 1]
    return out


@compiled
def piecewise_covariance(around: Floats, weights: Floats, off: Floats, normal: Floats) -> Floats:
    """Covariance (2, 2) in px^2 of an axis fitted to edges whose errors are alike in each piece.

    Shading, reflections and background shift uncorrected half-level crossings: each of the
    `_BLOCKS` pieces of the outline as a whole, by about the RMS residual.

    The arguments are those of `center_covariance`; residuals of rays left out are 0.
    """
    n, total, pulls = len(off), np.zeros((3, 3)), _design(around) * weights
    for block in range(_BLOCKS):
        row = pulls[:, block * n // _BLOCKS : (block + 1) * n // _BLOCKS].sum(axis=1)
        total += np.outer(row, row)
    rest, used = np.sum(off * off * (weights > 0)), np.sum(weights > 0)
    # The three unknowns fitted take up their share of the pieces' scatter.
    each = rest / max(float(used), 1.0) * _BLOCKS / (_BLOCKS - 3)
    known = inverse(normal)
    return (known + each * (known @ total @ known))[:2, :2]
