"""How an outline's edges spread about it, and what that means for its centre in the picture."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.model.lens import to_pixel

_BLOCKS = 12
_WAVES = 12
_STEEPNESS = 1.5
"""The power of an outline's errors falls with this power of their waves round it: so fall, in the
mean of seventeen rendered recordings, the residuals' waves from the second one to the fifth."""
_POWERS = tuple(float(max(wave, 1) ** -_STEEPNESS) for wave in range(_WAVES + 1))
_LANES = 16
"""Waves are filled up to a multiple of the machine's vector; one more than `_WAVES` is used."""
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
    known, (cosines, sines) = inverse(normal), _waves_in_arcs(around, weights)
    answers = _answers(_summed(cosines), _summed(sines), known)
    out, left, seen = np.zeros((2, 2)), _left(answers, cosines, sines), 0.0
    for wave in range(_WAVES + 1):
        for part in range(2):
            x, y = answers[part, 0, wave], answers[part, 1, wave]
            out[0, 0] += _POWERS[wave] * x * x
            out[0, 1] += _POWERS[wave] * x * y
            out[1, 1] += _POWERS[wave] * y * y
    out[1, 0] = out[0, 1]
    for arc in range(_ARCS):
        if cosines[arc, 0] > 0:
            total = 0.0
            for i in range(_begins(arc, len(off)), _begins(arc + 1, len(off))):
                total += weights[i] * off[i]
            seen += total * total / cosines[arc, 0]
    return out * (seen / left) + known[:2, :2]


@compiled
def _waves_in_arcs(around: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Weighted sums over each arc of the cosines (a, w) and sines (a, w) of waves round an outline.

    Wave 0 is even: its cosines' sums are those of the weights. All waves at once: each turns by its
    own angle from ray to ray.
    """
    n = len(weights)
    cosines, sines = np.zeros((_ARCS, _LANES)), np.zeros((_ARCS, _LANES))
    x, y, by = np.ones(_LANES), np.zeros(_LANES), np.empty((2, _LANES))
    for wave in range(_LANES):
        by[0, wave], by[1, wave] = around[wave % n, 0], around[wave % n, 1]
    for arc in range(_ARCS):
        for i in range(_begins(arc, n), _begins(arc + 1, n)):
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
def _begins(arc: int, rays: int) -> int:
    """The first of so many rays that lies in an arc."""
    return (arc * rays + _ARCS - 1) // _ARCS


@compiled
def _answers(cosines: Floats, sines: Floats, known: Floats) -> Floats:
    """The fit's answers (2, 3, w) to edges shifted by cosine and by sine waves.

    Args:
        cosines: (w,) the waves' weighted sums all round the outline.
        sines: (w,) likewise.
        known: (3, 3) inverse of the fit's normal matrix.
    """
    out = np.zeros((2, 3, _LANES))
    for wave in range(_WAVES + 1):
        # A product of waves, here with the first one, is half the sum of two others.
        more, less, sign = wave + 1, abs(wave - 1), 1.0 if wave > 0 else -1.0
        x1, y2 = cosines[less] + cosines[more], cosines[less] - cosines[more]
        x2, y1 = sines[more] + sign * sines[less], sines[more] - sign * sines[less]
        for a in range(3):
            along, aside, even = 0.5 * known[a, 0], 0.5 * known[a, 1], known[a, 2]
            out[0, a, wave] = along * x1 + aside * y1 + even * cosines[wave]
            out[1, a, wave] = along * x2 + aside * y2 + even * sines[wave]
    return out


@compiled
def _left(answers: Floats, cosines: Floats, sines: Floats) -> float:
    """Weighted square sum of what the answers leave of waves of `_POWERS` in the arcs' means."""
    left = np.zeros(_LANES)
    for arc in range(len(cosines)):
        x, y, mass = cosines[arc, 1], sines[arc, 1], cosines[arc, 0]
        per = 1 / mass if mass > 0 else 0.0
        for wave in range(len(left)):
            first, second = answers[0, :, wave], answers[1, :, wave]
            a = cosines[arc, wave] - (first[0] * x + first[1] * y + first[2] * mass)
            b = sines[arc, wave] - (second[0] * x + second[1] * y + second[2] * mass)
            left[wave] += per * (a * a + b * b)
    total = 0.0
    for wave in range(_WAVES + 1):
        total += _POWERS[wave] * left[wave]
    return total


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
