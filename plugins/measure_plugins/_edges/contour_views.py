"""What shifts all outlines of a view alike: a camera that is off, as far as its calibration says.

Ball-views of one camera then err together. A fit that takes each to err by itself asks too little
of how they lie to each other, which hardly changes, and of what it reads from their scatter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure_plugins._edges.contour_terms import OWN, SHARED, Terms

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
