"""How far ball-views' outlines sit off, estimated together with the pose, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._joint_fit.elimination import OWN, Terms
from measure_plugins._joint_fit.problem import Contours
from measure_plugins._kernels.selection import median

_START_PX = 3.0
"""Outlines are free to sit anywhere at first: else one that does takes all its points for bad."""
_PRIOR_PX = 0.03
_PRIOR_COUNT = 1.0
_FLOOR_PX = 0.003
_TAILS = 4.0
"""Degrees of freedom of the ball-views' shifts, a few of which are several times the others'."""
_GROSS = 5.0
_LEAST_TYPICAL_PX = 0.2
"""Ball-views off by more than so many typical standard deviations must not raise the variance. Off
by half a pixel they are no strangers: what light shifts in one camera it shifts back in another."""
_RADIUS_FLOOR_PX = 0.1
"""Balls are not round to better than this, and their edges differ: sizes never tell range finer."""


class Scatter(NamedTuple):
    """What is taken of the ball-views' shifts.

    Attributes:
        variance: (3,) of x, y and radius, px^2.
        doubt: (k,) by how much more some of them may be off.
    """

    variance: Floats
    doubt: Floats


@compiled
def free_scatter(k: int) -> Scatter:
    """Of k ball-views of which nothing is known."""
    return Scatter(np.full(OWN, _START_PX**2), np.ones(k))


@compiled
def own_variances(contours: Contours, scatter: Scatter, out: Floats) -> None:
    """Fill the variances (k, 3) of the ball-views' own shifts."""
    for k in range(len(out)):
        for a in range(OWN):
            spread = contours.spread[k] if a < 2 else 1.0
            out[k, a] = scatter.doubt[k] * spread * scatter.variance[a]


@compiled
def update_scatter(
    contours: Contours,
    terms: Terms,
    covariance: Floats,
    shifts: Floats,
    variances: Floats,
    scatter: Scatter,
) -> None:
    """Estimate the variances of the ball-views' shifts by restricted likelihood, and the doubts.

    The fixed point v = sum(b^2) / sum(1 - posterior variance / v) is MacKay's (1992) for random
    effects; the posterior variances hold the uncertainty of the shared unknowns, which makes it the
    restricted likelihood's (Laird and Ware 1982). The centres' shifts are Student's: the doubts are
    the inverse weights of Lange, Little and Taylor (1989).
    """
    variance, doubt = scatter
    prior = _PRIOR_COUNT * _PRIOR_PX**2
    center, known_center = prior, _PRIOR_COUNT
    radius, known_radius = prior, _PRIOR_COUNT
    apart = np.empty(len(doubt))
    for k in range(len(doubt)):
        for a in range(OWN):
            spread = terms.own[k, a, a]
            spread += _variance(terms.gain[k, a], covariance, 6 + contours.view_of[k])
            known = min(max(1 - spread / variances[k, a], 0.02), 1.0)
            if a < 2:
                center += shifts[k, a] ** 2 / (doubt[k] * contours.spread[k])
                known_center += known
            else:
                radius += shifts[k, a] ** 2 / doubt[k]
                known_radius += known
        apart[k] = (shifts[k, 0] ** 2 + shifts[k, 1] ** 2) / contours.spread[k]
    variance[:2] = max(center / known_center, _FLOOR_PX**2)
    variance[2] = max(radius / known_radius, _RADIUS_FLOOR_PX**2)
    typical = max(median(apart.copy(), len(apart)) / 1.386, _LEAST_TYPICAL_PX**2)
    for k in range(len(doubt)):
        gross = (apart[k] / (_GROSS**2 * typical)) ** 2
        doubt[k] = max(gross, (_TAILS + apart[k] / variance[0]) / (_TAILS + 2))


@compiled
def _variance(gain: Floats, covariance: Floats, offset: int) -> float:
    """Variance of `gain` (7,) times the pose and one offset, whose row of `covariance` is told."""
    total = gain[6] ** 2 * covariance[offset, offset]
    for i in range(6):
        row = gain[6] * covariance[offset, i]
        for j in range(i):
            row += gain[j] * covariance[i, j]
        total += gain[i] * (2 * row + gain[i] * covariance[i, i])
    return float(total)
