"""What ball-views say about the pose and their views' offsets, compiled.

Each ball-view has three unknowns of its own: its whole outline may sit off by (bx, by) in the
picture and be larger by br. They are random, and are eliminated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled

OWN = 3
"""Number of a ball-view's own unknowns."""
SHARED = 7
"""What a ball-view shares with others: the pose and its view's offset."""
_X, _Y, _RADIUS, _RESIDUAL = 7, 8, 6, 9
"""Columns of the moments; br goes as the view's offset does."""


class Terms(NamedTuple):
    """What k ball-views say about their shared unknowns, their own eliminated.

    Attributes:
        normal: (k, 7, 7) reduced normal matrices.
        right: (k, 7) reduced right sides.
        offset: (k, 3) the own unknowns are `offset - gain @ shared`.
        gain: (k, 3, 7).
        own: (k, 3, 3) covariance of the own unknowns, given the shared ones.
    """

    normal: Floats
    right: Floats
    offset: Floats
    gain: Floats
    own: Floats


@compiled
def empty_terms(k: int) -> Terms:
    """Room for the terms of k ball-views."""
    return Terms(
        np.zeros((k, SHARED, SHARED)),
        np.zeros((k, SHARED)),
        np.zeros((k, OWN)),
        np.zeros((k, OWN, SHARED)),
        np.zeros((k, OWN, OWN)),
    )


@compiled
def eliminate(moments: Floats, variances: Floats, terms: Terms) -> None:
    """Fill the terms of k ball-views; not a number where a step led inside a ball.

    Args:
        moments: (k, 10, 10) see `contour_moments`.
        variances: (k, 3) of the own unknowns, px^2.
        terms: filled.
    """
    for k in range(len(moments)):
        m, gain, inverse = moments[k], terms.gain[k], terms.own[k]
        _invert_own(m, variances[k], inverse)
        for a in range(OWN):
            x, y, z = inverse[a, 0], inverse[a, 1], inverse[a, 2]
            for j in range(SHARED):
                gain[a, j] = x * m[_X, j] + y * m[_Y, j] + z * m[_RADIUS, j]
            offset = x * m[_X, _RESIDUAL] + y * m[_Y, _RESIDUAL] + z * m[_RADIUS, _RESIDUAL]
            terms.offset[k, a] = offset
        u, v, w = terms.offset[k]
        for i in range(SHARED):
            x, y, z = m[i, _X], m[i, _Y], m[i, _RADIUS]
            terms.right[k, i] = m[i, _RESIDUAL] - (x * u + y * v + z * w)
            for j in range(i + 1):
                taken = x * gain[0, j] + y * gain[1, j] + z * gain[2, j]
                terms.normal[k, i, j] = terms.normal[k, j, i] = m[i, j] - taken


@compiled
def _invert_own(m: Floats, variances: Floats, out: Floats) -> None:
    """The inverse of the own unknowns' normal matrix (3, 3), their variances in it."""
    a, b, c = m[_X, _X] + 1 / variances[0], m[_X, _Y], m[_X, _RADIUS]
    d, e = m[_Y, _Y] + 1 / variances[1], m[_Y, _RADIUS]
    f = m[_RADIUS, _RADIUS] + 1 / variances[2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    unit = 1 / (a * p + b * q + c * r)
    out[0, 0], out[0, 1], out[0, 2] = unit * p, unit * q, unit * r
    out[1, 1], out[1, 2] = unit * (a * f - c * c), unit * (b * c - a * e)
    out[2, 2] = unit * (a * d - b * b)
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@compiled
def own_unknowns(view_of: Ints, terms: Terms, step: Floats, out: Floats) -> None:
    """Fill the ball-views' own unknowns (k, 3), given the step (6 + c,) of the shared ones."""
    for k in range(len(out)):
        for a in range(OWN):
            taken = terms.gain[k, a, 6] * step[6 + view_of[k]]
            for j in range(6):
                taken += terms.gain[k, a, j] * step[j]
            out[k, a] = terms.offset[k, a] - taken
