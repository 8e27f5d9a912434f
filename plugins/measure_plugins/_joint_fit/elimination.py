"""What ball-views say about the pose and their views' offsets, compiled.

Each ball-view has three unknowns of its own: its whole outline may sit off by (bx, by) in the
picture and be larger by br. They are random, and are eliminated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined

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


_PLANE = 2
_BELIEVED = 9.2
"""A view's shift's normalised square beyond which its camera is doubted: 1 in 100 (chi^2). Cameras
get moved after they were calibrated."""


class Aside(NamedTuple):
    """The shifts of c views, `offset - gain @ shared`, see `Terms`.

    Attributes:
        variance: (c, 2, 2) what they may be, px^2; zero for cameras that are exact.
        doubt: (c,) by how much more they seem to be.
        shift: (c, 2).
        offset: (c, 2).
        gain: (c, 2, 7).
    """

    variance: Floats
    doubt: Floats
    shift: Floats
    offset: Floats
    gain: Floats


@compiled
def unseen(variance: Floats) -> Aside:
    """Of c views whose shifts may be (c, 2, 2), before anything is known of them."""
    c = len(variance)
    shift, offset = np.zeros((c, _PLANE)), np.zeros((c, _PLANE))
    return Aside(variance, np.ones(c), shift, offset, np.zeros((c, _PLANE, SHARED)))


@compiled
def set_aside(view_of: Ints, variances: Floats, terms: Terms, aside: Aside) -> None:
    """Eliminate the views' shifts as well, after the ball-views' own unknowns.

    A view's shift moves its outlines as (x, y) of each does. Once those are eliminated, with V
    their variances and S what `Terms.own` holds, it has the normal matrix sum(V^-1 - V^-1 S V^-1),
    the right side sum(V^-1 offset), and sum(V^-1 gain) between it and what is shared.

    Args:
        view_of: (k,) of the ball-views.
        variances: (k, 3) of the own unknowns, as `eliminate` had them.
        terms: of k ball-views; changed. The sum of `normal` over a view remains symmetric.
        aside: filled.
    """
    normal, inverse = np.empty((_PLANE, _PLANE)), np.empty((_PLANE, _PLANE))
    for view in range(len(aside.variance)):
        if not _uncertain(aside, view):
            continue
        offset, gain = aside.offset[view], aside.gain[view]
        normal[:], offset[:], gain[:] = 0.0, 0.0, 0.0
        for k in range(len(view_of)):
            if view_of[k] == view:
                _add_up(k, variances[k], terms, normal, offset, gain)
        _fill_posterior(aside.doubt[view], aside.variance[view], normal, inverse)
        x, y = offset
        offset[0] = inverse[0, 0] * x + inverse[0, 1] * y
        offset[1] = inverse[1, 0] * x + inverse[1, 1] * y
        for j in range(SHARED):
            x, y = gain[0, j], gain[1, j]
            gain[0, j] = inverse[0, 0] * x + inverse[0, 1] * y
            gain[1, j] = inverse[1, 0] * x + inverse[1, 1] * y
        for k in range(len(view_of)):
            if view_of[k] == view:
                _take_out(k, variances[k], inverse, offset, gain, terms)


@inlined
def _uncertain(aside: Aside, view: int) -> bool:
    return bool(aside.variance[view, 0, 0] + aside.variance[view, 1, 1] > 0)


@inlined
def _add_up(
    k: int, variances: Floats, terms: Terms, normal: Floats, offset: Floats, gain: Floats
) -> None:
    """Add what ball-view k says of its view's shift: (2, 2), (2,) and (2, 7)."""
    for a in range(_PLANE):
        weight = 1 / variances[a]
        normal[a, a] += weight
        offset[a] += weight * terms.offset[k, a]
        for b in range(_PLANE):
            normal[a, b] -= weight * terms.own[k, a, b] / variances[b]
        for j in range(SHARED):
            gain[a, j] += weight * terms.gain[k, a, j]


@inlined
def _fill_posterior(doubt: float, prior: Floats, normal: Floats, out: Floats) -> None:
    """Fill ((doubt prior)^-1 + normal)^-1 (2, 2), for priors that may be certain of an axis."""
    p, q, r = doubt * prior[0, 0], doubt * prior[0, 1], doubt * prior[1, 1]
    a, b = 1 + p * normal[0, 0] + q * normal[1, 0], p * normal[0, 1] + q * normal[1, 1]
    c, d = q * normal[0, 0] + r * normal[1, 0], 1 + q * normal[0, 1] + r * normal[1, 1]
    unit = 1 / (a * d - b * c)
    out[0, 0], out[0, 1] = unit * (d * p - b * q), unit * (d * q - b * r)
    out[1, 0], out[1, 1] = unit * (a * q - c * p), unit * (a * r - c * q)


@inlined
def _take_out(
    k: int, variances: Floats, inverse: Floats, offset: Floats, gain: Floats, terms: Terms
) -> None:
    """Eliminate a view's shift from the terms of one of its ball-views.

    Args:
        k: the ball-view.
        variances: (3,) of its own unknowns.
        inverse: (2, 2) covariance of the view's shift, given what is shared.
        offset: (2,) see `Aside`.
        gain: (2, 7) see `Aside`.
        terms: changed.
    """
    right, normal, own = terms.right[k], terms.normal[k], terms.own[k]
    for a in range(_PLANE):
        unit, off = 1 / variances[a], terms.offset[k, a]
        for i in range(SHARED):
            pull = unit * gain[a, i]
            right[i] -= pull * off
            for j in range(SHARED):
                normal[i, j] -= pull * terms.gain[k, a, j]
    # How the own unknowns give way to the view's shift.
    lever = np.empty((OWN, _PLANE))
    for a in range(OWN):
        for b in range(_PLANE):
            lever[a, b] = (a == b) - own[a, b] / variances[b]
    for a in range(OWN):
        x, y = lever[a, 0], lever[a, 1]
        terms.offset[k, a] -= x * offset[0] + y * offset[1]
        for j in range(SHARED):
            terms.gain[k, a, j] -= x * gain[0, j] + y * gain[1, j]
        p, q = x * inverse[0, 0] + y * inverse[1, 0], x * inverse[0, 1] + y * inverse[1, 1]
        for b in range(OWN):
            own[a, b] += p * lever[b, 0] + q * lever[b, 1]


@compiled
def update_aside(step: Floats, aside: Aside) -> None:
    """Fill the views' shifts, given the step (6 + c,) of what is shared, and the doubts."""
    for view in range(len(aside.variance)):
        if not _uncertain(aside, view):
            continue
        square = 0.0
        for a in range(_PLANE):
            shift = aside.offset[view, a] - aside.gain[view, a, 6] * step[6 + view]
            for j in range(6):
                shift -= aside.gain[view, a, j] * step[j]
            aside.shift[view, a] = shift
            square += shift * shift
        square /= (aside.variance[view, 0, 0] + aside.variance[view, 1, 1]) / 2
        aside.doubt[view] = max(1.0, square / _BELIEVED)


@compiled
def take_back(view_of: Ints, aside: Aside, by_shift: Floats, covariance: Floats) -> None:
    """Take from a fitted pose's covariance (6, 6) what the views' shifts may add to it.

    Args:
        view_of: (k,) of the ball-views.
        aside: the shifts.
        by_shift: (k, 6, 3) how the pose reacts to the ball-views' shifts.
        covariance: changed.
    """
    for view in range(len(aside.variance)):
        if _uncertain(aside, view):
            lever = np.zeros((6, _PLANE))
            for k in range(len(view_of)):
                if view_of[k] == view:
                    lever += by_shift[k, :, :_PLANE]
            covariance -= lever @ aside.variance[view] @ lever.T
