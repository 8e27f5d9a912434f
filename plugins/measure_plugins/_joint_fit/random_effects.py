"""Variances of the ball-views' random effects, estimated together with the pose, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._joint_fit.elimination import EFFECTS, ReducedEquations
from measure_plugins._joint_fit.problem import PackedOutlines

_INITIAL_SD_PX = 3.0
"""Wide enough for any outline: with less, Tukey's weights would reject all points of one that is
shifted by several px."""
_PRIOR_SD_PX = 0.03
_PRIOR_COUNT = 1.0
_MIN_SD_PX = 0.003
_DEGREES_OF_FREEDOM = 4.0
"""Of Student's t distribution of the effects bx and by, a few of which are several times larger
than the others."""
_MAX_TYPICAL_SDS = 5.0
"""An effect beyond so many typical standard deviations must not raise the variance ..."""
_MIN_TYPICAL_SD_PX = 0.2
"""... of which a typical one counts as no less than this: half a pixel is not gross, for a shift by
light in one camera is balanced by that in another."""
_MIN_RADIUS_SD_PX = 0.1
"""Balls are not round to better than this, and edges differ: a size determines range no better."""
_CHI_SQUARE_MEDIAN = 1.386  # With 2 degrees of freedom: 2 ln 2


class EffectVariance(NamedTuple):
    """Student's t distribution of the random effects."""

    variance: Floats  # (3,) of bx, by and br, px^2
    inverse_weight: Floats  # (k,) factor of a ball-view's variances: large for outlying effects


@compiled
def initial_effect_variance(k: int) -> EffectVariance:
    """Of k ball-views, before the first iteration."""
    return EffectVariance(np.full(EFFECTS, _INITIAL_SD_PX**2), np.ones(k))


@compiled
def fill_effect_variances(
    outlines: PackedOutlines, distribution: EffectVariance, out: Floats
) -> None:
    """Fill the variances (k, 3) of the effects: docs/explanation/joint_fit.md, formula 6."""
    for k in range(len(out)):
        for a in range(EFFECTS):
            relative = outlines.relative_variance[k] if a < 2 else 1.0
            out[k, a] = distribution.inverse_weight[k] * relative * distribution.variance[a]


@compiled
def update_effect_variance(
    outlines: PackedOutlines,
    equations: ReducedEquations,
    covariance: Floats,
    effects: Floats,
    variances: Floats,
    distribution: EffectVariance,
) -> None:
    """Estimate the effects' variances by restricted likelihood, and their inverse weights.

    The fixed point v = sum(b^2) / sum(1 - posterior variance / v) is MacKay's (1992) for random
    effects; the posterior variances hold the uncertainty of the shared unknowns, which makes it the
    restricted likelihood's (Laird and Ware 1982). bx and by have Student's t distribution: the
    inverse weights are those of Lange, Little and Taylor (1989). See docs/explanation/joint_fit.md,
    formulas 13 and 14.
    """
    variance, inverse_weight = distribution
    prior = _PRIOR_COUNT * _PRIOR_SD_PX**2
    center, known_center = prior, _PRIOR_COUNT
    radius, known_radius = prior, _PRIOR_COUNT
    square = np.empty(len(inverse_weight))
    for k in range(len(inverse_weight)):
        for a in range(EFFECTS):
            posterior = equations.effect_covariance[k, a, a]
            back = equations.back_substitution[k, a]
            posterior += _variance(back, covariance, 6 + outlines.view_of[k])
            known = min(max(1 - posterior / variances[k, a], 0.02), 1.0)
            if a < 2:
                center += effects[k, a] ** 2 / (inverse_weight[k] * outlines.relative_variance[k])
                known_center += known
            else:
                radius += effects[k, a] ** 2 / inverse_weight[k]
                known_radius += known
        square[k] = (effects[k, 0] ** 2 + effects[k, 1] ** 2) / outlines.relative_variance[k]
    variance[:2] = max(center / known_center, _MIN_SD_PX**2)
    variance[2] = max(radius / known_radius, _MIN_RADIUS_SD_PX**2)
    typical = max(np.median(square) / _CHI_SQUARE_MEDIAN, _MIN_TYPICAL_SD_PX**2)
    for k in range(len(inverse_weight)):
        gross = (square[k] / (_MAX_TYPICAL_SDS**2 * typical)) ** 2
        inverse_weight[k] = max(
            gross, (_DEGREES_OF_FREEDOM + square[k] / variance[0]) / (_DEGREES_OF_FREEDOM + 2)
        )


@compiled
def _variance(back: Floats, covariance: Floats, offset: int) -> float:
    """Variance of `back` (7,) times the pose and the edge offset in row `offset`."""
    total = back[6] ** 2 * covariance[offset, offset]
    for i in range(6):
        row = back[6] * covariance[offset, i]
        for j in range(i):
            row += back[j] * covariance[i, j]
        total += back[i] * (2 * row + back[i] * covariance[i, i])
    return float(total)
