"""How an outline's edges spread about it, and what that means for its centre in the picture."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.model.lens import to_pixel

_BLOCKS = 12
_WAVES = 12
_STEEPNESS = 1.5
"""The power of an outline's errors falls with this power of their waves round it: so fall, in the
mean of seventeen rendered recordings, the residuals' waves from the second one to the fifth."""
_POWERS = tuple(float(max(wave, 1) ** -_STEEPNESS) for wave in range(_WAVES + 1))
_ARCS = 24
"""Edges scatter within such arcs by noise, which their means are all but free of."""


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
    """Covariance (2, 2) of a cone's axis along e1 and e2, in px^2, by how its edges scatter.

    Shading, reflections and what stands behind shift edges alike over arcs of any length; what
    shifts one half of the outline out and the other in moves the centre and leaves no residual. So
    it is inferred from the shorter waves, which do: the fit's answer to all waves, scaled by the
    scatter of short arcs' means, comes on top of what independent edges leave open.

    Args:
        around: (n, 2) cosine and sine of evenly spaced rays around the axis.
        weights: (n,) of the edges in the fit, px^-2; 0 for rays left out.
        off: (n,) the edges' residuals, px.
        normal: (3, 3) of the fit: axis along e1 and e2, growth.
    """
    known, answers = inverse(normal), np.empty((2, 3))
    arc_of = np.arange(len(off)) * _ARCS // len(off)
    arcs = _arc_sums(around, weights, arc_of)
    out, left, seen = np.zeros((2, 2)), 0.0, 0.0
    for wave in range(_WAVES + 1):
        left += _POWERS[wave] * _answers(around, weights, arc_of, arcs, known, wave, answers)
        for part in range(2):
            for a in range(2):
                for b in range(2):
                    out[a, b] += _POWERS[wave] * answers[part, a] * answers[part, b]
    sums = np.zeros(_ARCS)
    for i in range(len(off)):
        sums[arc_of[i]] += weights[i] * off[i]
    for arc in range(_ARCS):
        if arcs[arc, 2] > 0:
            seen += sums[arc] ** 2 / arcs[arc, 2]
    return out * (seen / left) + known[:2, :2]


@compiled
def _arc_sums(around: Floats, weights: Floats, arc_of: Ints) -> Floats:
    """Sums over arcs (a, 3) of the weighted cosines and sines, and of the weights."""
    out = np.zeros((_ARCS, 3))
    for i in range(len(weights)):
        arc = arc_of[i]
        out[arc, 0] += weights[i] * around[i, 0]
        out[arc, 1] += weights[i] * around[i, 1]
        out[arc, 2] += weights[i]
    return out


@compiled
def _answers(
    around: Floats,
    weights: Floats,
    arc_of: Ints,
    arcs: Floats,
    known: Floats,
    wave: int,
    answers: Floats,
) -> float:
    """The fit's answers (2, 3) to edges shifted by a cosine and by a sine wave.

    And the weighted square sum of what they leave in the arcs' means. The rays' own cosines and
    sines serve for all waves.
    """
    n, turned, sums = len(around), 0, np.zeros((_ARCS, 2))
    x1, y1, total1, x2, y2, total2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        cosine, sine = weights[i] * around[turned, 0], weights[i] * around[turned, 1]
        turned = turned + wave if turned + wave < n else turned + wave - n
        x1, y1, total1 = x1 + cosine * around[i, 0], y1 + cosine * around[i, 1], total1 + cosine
        x2, y2, total2 = x2 + sine * around[i, 0], y2 + sine * around[i, 1], total2 + sine
        sums[arc_of[i], 0] += cosine
        sums[arc_of[i], 1] += sine
    for a in range(3):
        answers[0, a] = known[a, 0] * x1 + known[a, 1] * y1 + known[a, 2] * total1
        answers[1, a] = known[a, 0] * x2 + known[a, 1] * y2 + known[a, 2] * total2
    left = 0.0
    for arc in range(_ARCS):
        c, s, mass = arcs[arc]
        if mass > 0:
            for part in range(2):
                kept = answers[part, 0] * c + answers[part, 1] * s + answers[part, 2] * mass
                left += (sums[arc, part] - kept) ** 2 / mass
    return left


@compiled
def in_pieces(around: Floats, weights: Floats, off: Floats, normal: Floats) -> Floats:
    """Covariance (2, 2) in px^2 of an axis fitted to edges whose errors go together piece by piece.

    Half-level crossings that are not corrected are off by shading, reflections and what stands
    behind: each piece of the outline as a whole, by about as much as the edges leave unexplained.
    A piece seen alone hardly tells a shift from growth, and so counts by its lever.

    Args:
        around: (n, 2) cosine and sine around the axis.
        weights: (n,) of the edges in the fit, px^-2; 0 for rays left out.
        off: (n,) the edges' residuals, px; 0 for rays left out.
        normal: (3, 3) of the fit, px^-2.
    """
    n, row, total = len(off), np.empty(3), np.zeros((3, 3))
    rest, used = 0.0, 0
    for block in range(_BLOCKS):
        row[:] = 0.0
        for i in range(block * n // _BLOCKS, (block + 1) * n // _BLOCKS):
            if weights[i] > 0:
                row[0] += weights[i] * around[i, 0]
                row[1] += weights[i] * around[i, 1]
                row[2] += weights[i]
                rest += off[i] * off[i]
                used += 1
        for a in range(3):
            for b in range(3):
                total[a, b] += row[a] * row[b]
    # Three unknowns fitted to so many pieces take their part of the scatter with them.
    each = rest / max(used, 1) * _BLOCKS / (_BLOCKS - 3)
    known = inverse(normal)
    return (known + each * (known @ total @ known))[:2, :2]
