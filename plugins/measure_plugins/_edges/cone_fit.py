"""The cone through outline points, robustly: random sample consensus, then Tukey weights.

About a predicted cone, a turn of its axis by (d1, d2) and a change of its half angle by da move the
outline, along its normal, by `scale * (cos(phi) d1 + sin(phi) d2 + da)`: linear in three unknowns.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure_plugins._edges.jit import compiled

_TUKEY = 4.685
_ROUNDS = 6
_FURTHEST_PX = 1.6
"""A point further off than this belongs to something else, whatever the others scatter by."""


@compiled
def _three_point_solution(rows: Floats, values: Floats) -> tuple[float, float, float, bool]:
    (a, b, c), (d, e, f) = rows[0], rows[1]
    g, h, i = rows[2]
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if abs(det) < 1e-3:
        return 0.0, 0.0, 0.0, False
    p, q, r = values
    x = (p * (e * i - f * h) - b * (q * i - f * r) + c * (q * h - e * r)) / det
    y = (a * (q * i - f * r) - p * (d * i - f * g) + c * (d * r - q * g)) / det
    z = (a * (e * r - q * h) - b * (d * r - q * g) + p * (d * h - e * g)) / det
    return x, y, z, True


@compiled
def consensus(shifts: Floats, around: Floats, use: Floats, gate_px: float, trials: int) -> Floats:
    """The three-point solution most points agree with.

    Args:
        shifts: (n,) outline shifts along the normals, px.
        around: (n, 2) cosine and sine around the axis.
        use: (n,) 1 for points to use, else 0.
        gate_px: how near a point must be to agree.
        trials: number of triples; a fixed sequence, so that results repeat.

    Returns:
        (3,) shift in px of the axis along e1 and e2, and growth of the radius.
    """
    index = np.nonzero(use)[0]
    n = len(index)
    best, out = -1.0, np.zeros(3)
    rows, values = np.ones((3, 3)), np.empty(3)
    state = np.uint64(12345)
    for _ in range(trials):
        for k in range(3):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            pick = index[(state >> np.uint64(33)) % np.uint64(n)]
            rows[k, 0], rows[k, 1] = around[pick, 0], around[pick, 1]
            values[k] = shifts[pick]
        x, y, z, good = _three_point_solution(rows, values)
        if not good:
            continue
        score = 0.0
        for j in range(n):
            i = index[j]
            r = abs(shifts[i] - (around[i, 0] * x + around[i, 1] * y + z)) / gate_px
            if r < 1:
                score += 1 - r * r
        if score > best:
            best = score
            out[0], out[1], out[2] = x, y, z
    return out


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
    """Iterated Tukey-weighted least squares from `start`.

    Args:
        shifts: (n,) outline shifts along the normals, px.
        around: (n, 2) cosine and sine around the axis.
        sd: (n,) standard deviations of the shifts, px.
        use: (n,) 1 for points to use, else 0.
        start: (3,) to start from.
        gate_px: how near a point must be at first.
        growth: mean and sd in px of what is known of the growth before.

    Returns:
        Solution (3,) as in `consensus`, normal matrix (3, 3) of the weighted fit in px^-2, the
        points' final robust weights (n,), and the residuals' robust scale in units of `sd`.
    """
    solution, weights = start.copy(), use.copy()
    normal, scale = np.zeros((3, 3)), 1.0
    row = np.ones(3)
    n = len(shifts)
    standard = np.empty(n)
    for turn in range(_ROUNDS):
        count = 0
        for i in range(n):
            if use[i] > 0:
                r = shifts[i] - (
                    around[i, 0] * solution[0] + around[i, 1] * solution[1] + solution[2]
                )
                near = abs(r) < gate_px if turn == 0 else weights[i] > 0
                if near:
                    standard[count] = abs(r) / sd[i]
                    count += 1
        if count < 4:
            return solution, normal, np.zeros(n), np.inf
        ordered = np.sort(standard[:count])
        scale = max(1.4826 * ordered[count // 2], 0.3)
        normal[:] = 0.0
        right = np.zeros(3)
        normal[2, 2] = 1 / growth[1] ** 2
        right[2] = growth[0] / growth[1] ** 2
        for i in range(n):
            weights[i] = 0.0
            if use[i] == 0:
                continue
            row[0], row[1] = around[i, 0], around[i, 1]
            r = shifts[i] - np.sum(row * solution)
            t = r / min(sd[i] * scale * _TUKEY, _FURTHEST_PX)
            if abs(t) < 1:
                weights[i] = (1 - t * t) ** 2
                w = weights[i] / (sd[i] * scale) ** 2
                for a in range(3):
                    right[a] += w * row[a] * shifts[i]
                    for b in range(3):
                        normal[a, b] += w * row[a] * row[b]
        if not np.linalg.det(normal) > 1e-7 * normal[2, 2] ** 3:
            return solution, normal, np.zeros(n), np.inf
        solution[:] = np.linalg.solve(normal, right)
    return solution, normal, weights, scale
