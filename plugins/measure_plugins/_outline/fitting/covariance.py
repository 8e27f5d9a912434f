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
