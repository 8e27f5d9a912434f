"""How an outline's edges spread about it, and what that means for its centre in the picture."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.compiling import compiled
from measure.model.lens import to_pixel

_BLOCKS = 12


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
def correlation(standard: Floats, inliers: Bools) -> float:
    """How much wider than for independent rays a mean over the outline scatters (batch means).

    Neighbouring rays share pixels, shading and what stands behind: their errors go together.
    """
    n = len(standard)
    squares, rays, blocks = 0.0, 0, 0
    for block in range(_BLOCKS):
        total, count = 0.0, 0
        for i in range(block * n // _BLOCKS, (block + 1) * n // _BLOCKS):
            if inliers[i]:
                total += standard[i]
                count += 1
        if count > 1:
            squares += total * total
            rays += count
            blocks += 1
    return max(1.0, squares / rays) if blocks >= 4 else 4.0


@compiled
def in_pieces(
    shifts: Floats, sd: Floats, around: Floats, weights: Floats, solution: Floats, normal: Floats
) -> Floats:
    """Covariance (2, 2) in px^2 of an axis fitted to edges whose errors go together piece by piece.

    Half-level crossings that are not corrected are off by shading, reflections and what stands
    behind: each piece of the outline as a whole, by about as much as the edges leave unexplained.
    A piece seen alone hardly tells a shift from growth, and so counts by its lever.

    Args:
        shifts: (n,) of the edges, px.
        sd: (n,) their standard deviations, px.
        around: (n, 2) cosine and sine around the axis.
        weights: (n,) robust weights of the fit.
        solution: (3,) of the fit.
        normal: (3, 3) of the fit, px^-2.
    """
    n, row, total = len(shifts), np.empty(3), np.zeros((3, 3))
    rest, used = 0.0, 0
    for block in range(_BLOCKS):
        row[:] = 0.0
        for i in range(block * n // _BLOCKS, (block + 1) * n // _BLOCKS):
            if weights[i] > 0:
                x, y, weight = around[i, 0], around[i, 1], weights[i] / sd[i] ** 2
                off = shifts[i] - (x * solution[0] + y * solution[1] + solution[2])
                row[0], row[1], row[2] = row[0] + weight * x, row[1] + weight * y, row[2] + weight
                rest += off * off
                used += 1
        for a in range(3):
            for b in range(3):
                total[a, b] += row[a] * row[b]
    # Three unknowns fitted to so many pieces take their part of the scatter with them.
    each = rest / max(used, 1) * _BLOCKS / (_BLOCKS - 3)
    inverse = np.linalg.inv(normal)
    return (inverse + each * (inverse @ total @ inverse))[:2, :2]
