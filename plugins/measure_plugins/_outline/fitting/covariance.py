"""Covariance of an outline's centre in the picture, from how its edges scatter about it.

See docs/explanation/outline.md, formula 17.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.model.lens import to_pixel

_BLOCKS = 12
_WAVES = 12
_STEEPNESS = 1.5
"""The power of the k-th wave of an outline's errors is taken as k to the minus this: so fall, in
the mean of seventeen rendered recordings, the residuals' waves from the second to the fifth."""
_POWERS = tuple(float(max(wave, 1) ** -_STEEPNESS) for wave in range(_WAVES + 1))
_LANES = 16  # Waves computed: a whole number of vectors, and one more than `_WAVES` is used
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
    known, (cosines, sines) = inverse(normal), _waves_in_arcs(around, weights)
    responses = _wave_responses(_summed(cosines), _summed(sines), known)
    out, left, seen = np.zeros((2, 2)), _unexplained(responses, cosines, sines), 0.0
    for wave in range(_WAVES + 1):
        for part in range(2):
            x, y = responses[part, 0, wave], responses[part, 1, wave]
            out[0, 0] += _POWERS[wave] * x * x
            out[0, 1] += _POWERS[wave] * x * y
            out[1, 1] += _POWERS[wave] * y * y
    out[1, 0] = out[0, 1]
    for arc in range(_ARCS):
        if cosines[arc, 0] > 0:
            total = 0.0
            for i in range(_arc_start(arc, len(off)), _arc_start(arc + 1, len(off))):
                total += weights[i] * off[i]
            seen += total * total / cosines[arc, 0]
    return out * (seen / left) + known[:2, :2]


@compiled
def _waves_in_arcs(around: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Weighted sums over each arc of the cosines (a, w) and sines (a, w) of waves round an outline.

    Wave 0 is constant: the sums of its cosines are those of the weights.
    """
    n = len(weights)
    cosines, sines = np.zeros((_ARCS, _LANES)), np.zeros((_ARCS, _LANES))
    x, y, by = np.ones(_LANES), np.zeros(_LANES), np.empty((2, _LANES))
    for wave in range(_LANES):
        by[0, wave], by[1, wave] = around[wave % n, 0], around[wave % n, 1]
    for arc in range(_ARCS):
        for i in range(_arc_start(arc, n), _arc_start(arc + 1, n)):
            for wave in range(len(x)):
                cosine, sine = x[wave], y[wave]
                cosines[arc, wave] += weights[i] * cosine
                sines[arc, wave] += weights[i] * sine
                x[wave] = by[0, wave] * cosine - by[1, wave] * sine
                y[wave] = by[1, wave] * cosine + by[0, wave] * sine
    return cosines, sines


@compiled
def _summed(rows: Floats) -> Floats:
    """Sum (n,) of rows (k, n)."""
    out = np.zeros(rows.shape[1])
    for row in rows:
        for i in range(len(out)):
            out[i] += row[i]
    return out


@compiled
def _arc_start(arc: int, rays: int) -> int:
    """The first of so many rays that lies in an arc."""
    return (arc * rays + _ARCS - 1) // _ARCS


@compiled
def _wave_responses(cosines: Floats, sines: Floats, known: Floats) -> Floats:
    """Solutions (2, 3, w) of the fit to edges shifted by cosine and by sine waves.

    Args:
        cosines: (w,) the waves' weighted sums all round the outline.
        sines: (w,) likewise.
        known: (3, 3) inverse of the fit's normal matrix.
    """
    out = np.zeros((2, 3, _LANES))
    for wave in range(_WAVES + 1):
        # The product of a wave and the first one is half the sum of two others.
        more, less, sign = wave + 1, abs(wave - 1), 1.0 if wave > 0 else -1.0
        x1, y2 = cosines[less] + cosines[more], cosines[less] - cosines[more]
        x2, y1 = sines[more] + sign * sines[less], sines[more] - sign * sines[less]
        for a in range(3):
            first, second, growth = 0.5 * known[a, 0], 0.5 * known[a, 1], known[a, 2]
            out[0, a, wave] = first * x1 + second * y1 + growth * cosines[wave]
            out[1, a, wave] = first * x2 + second * y2 + growth * sines[wave]
    return out


@compiled
def _unexplained(responses: Floats, cosines: Floats, sines: Floats) -> float:
    """Expected square sum of the arcs' mean residuals for waves of `_POWERS`."""
    left = np.zeros(_LANES)
    for arc in range(len(cosines)):
        x, y, mass = cosines[arc, 1], sines[arc, 1], cosines[arc, 0]
        per = 1 / mass if mass > 0 else 0.0
        for wave in range(len(left)):
            first, second = responses[0, :, wave], responses[1, :, wave]
            a = cosines[arc, wave] - (first[0] * x + first[1] * y + first[2] * mass)
            b = sines[arc, wave] - (second[0] * x + second[1] * y + second[2] * mass)
            left[wave] += per * (a * a + b * b)
    total = 0.0
    for wave in range(_WAVES + 1):
        total += _POWERS[wave] * left[wave]
    return total


@compiled
def piecewise_covariance(around: Floats, weights: Floats, off: Floats, normal: Floats) -> Floats:
    """Covariance (2, 2) in px^2 of an axis fitted to edges whose errors are alike in each piece.

    Shading, reflections and background shift uncorrected half-level crossings: each of the
    `_BLOCKS` pieces of the outline as a whole, by about the RMS residual.

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
    # The three unknowns fitted take up their share of the pieces' scatter.
    each = rest / max(used, 1) * _BLOCKS / (_BLOCKS - 3)
    known = inverse(normal)
    return (known + each * (known @ total @ known))[:2, :2]
