"""Random effects: eliminated from the normal equations by Schur complements; their variances.

A ball-view is one ball in one camera. Its whole outline may be shifted by (bx, by) in the picture
and be larger by br: its random effects, px. The shift that all outlines of a view have in common,
as an error of the camera's pose makes it, is the view's shift. See docs/explanation/joint_fit.md,
formulas 5 to 14.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure.limits import STUDENT_DEGREES
from measure_plugins._joint_fit.outlines import PackedOutlines

EFFECTS = 3
"""Number of a ball-view's random effects: bx, by, br."""
SHARED = 7
"""Unknowns that a ball-view shares with others: the pose's six and its view's edge offset."""
_X, _Y, _RADIUS, _RESIDUAL = 7, 8, 6, 9
"""Columns of the moments; br changes the residuals as the view's edge offset does."""


class ReducedEquations(NamedTuple):
    """Normal equations of k ball-views for their shared unknowns, the random effects eliminated."""

    normal: Floats  # (k, 7, 7) reduced normal matrices
    right: Floats  # (k, 7) reduced right sides
    offset: Floats  # (k, 3) the random effects are `offset - back_substitution @ shared`
    back_substitution: Floats  # (k, 3, 7)
    effect_covariance: Floats  # (k, 3, 3) of the random effects, given the shared unknowns


@compiled
def empty_equations(k: int) -> ReducedEquations:
    """Arrays for the equations of k ball-views."""
    return ReducedEquations(
        np.zeros((k, SHARED, SHARED)),
        np.zeros((k, SHARED)),
        np.zeros((k, EFFECTS)),
        np.zeros((k, EFFECTS, SHARED)),
        np.zeros((k, EFFECTS, EFFECTS)),
    )


@compiled
def eliminate(moments: Floats, variances: Floats, equations: ReducedEquations) -> None:
    """Fill the equations of k ball-views; NaN where a step led inside a ball.

    See docs/explanation/joint_fit.md, formulas 10 and 11.

    Args:
        moments: (k, 10, 10) see `residuals.accumulate_moments`.
        variances: (k, 3) of the random effects, px^2.
    """
    for k in range(len(moments)):
        m, back = moments[k], equations.back_substitution[k]
        inverse = equations.effect_covariance[k]
        _invert_effects(m, variances[k], inverse)
        for a in range(EFFECTS):
            x, y, z = inverse[a, 0], inverse[a, 1], inverse[a, 2]
            for j in range(SHARED):
                back[a, j] = x * m[_X, j] + y * m[_Y, j] + z * m[_RADIUS, j]
            offset = x * m[_X, _RESIDUAL] + y * m[_Y, _RESIDUAL] + z * m[_RADIUS, _RESIDUAL]
            equations.offset[k, a] = offset
        u, v, w = equations.offset[k]
        for i in range(SHARED):
            x, y, z = m[i, _X], m[i, _Y], m[i, _RADIUS]
            equations.right[k, i] = m[i, _RESIDUAL] - (x * u + y * v + z * w)
            for j in range(i + 1):
                taken = x * back[0, j] + y * back[1, j] + z * back[2, j]
                equations.normal[k, i, j] = equations.normal[k, j, i] = m[i, j] - taken


@compiled
def _invert_effects(m: Floats, variances: Floats, out: Floats) -> None:
    """Fill the inverse of the random effects' normal matrix (3, 3), with their prior variances."""
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
def back_substitute(view_of: Ints, equations: ReducedEquations, step: Floats, out: Floats) -> None:
    """Fill the random effects (k, 3), given the step (6 + c,) of the shared unknowns."""
    for k in range(len(out)):
        for a in range(EFFECTS):
            taken = equations.back_substitution[k, a, 6] * step[6 + view_of[k]]
            for j in range(6):
                taken += equations.back_substitution[k, a, j] * step[j]
            out[k, a] = equations.offset[k, a] - taken


_PLANE = 2
_MAX_SHIFT_SQUARE = 9.2
"""Square of a view's shift, in its variances, beyond which the variance is raised: exceeded by 1 in
100 (chi-square, 2 degrees of freedom). Cameras get moved after they were calibrated."""


class ViewShifts(NamedTuple):
    """The shifts (x, y) of c views, `offset - back_substitution @ shared`, px."""

    variance: Floats  # (c, 2, 2) of the shifts by the calibration, px^2; zero for exact cameras
    inverse_weight: Floats  # (c,) factor by which that is raised, 1 or more
    shift: Floats  # (c, 2) estimated
    offset: Floats  # (c, 2)
    back_substitution: Floats  # (c, 2, 7)


@compiled
def prior_view_shifts(variance: Floats) -> ViewShifts:
    """The shifts of c views with covariances (c, 2, 2), before the first iteration."""
    c = len(variance)
    shift, offset = np.zeros((c, _PLANE)), np.zeros((c, _PLANE))
    return ViewShifts(variance, np.ones(c), shift, offset, np.zeros((c, _PLANE, SHARED)))


@compiled
def eliminate_view_shifts(
    view_of: Ints, variances: Floats, equations: ReducedEquations, shifts: ViewShifts
) -> None:
    """Eliminate the views' shifts as well, after the ball-views' random effects.

    A view's shift moves its outlines as the effects (bx, by) of each do. Once those are eliminated,
    with V their variances, S their `effect_covariance` and B their `back_substitution`, the shift
    has the normal matrix sum(V^-1 - V^-1 S V^-1), the right side sum(V^-1 offset), and the block
    sum(V^-1 B) between it and the shared unknowns (docs/explanation/joint_fit.md, formula 12).

    Args:
        view_of: (k,) index of the ball-views' views.
        variances: (k, 3) of the random effects, as given to `eliminate`.
        equations: of k ball-views; changed. The sum of `normal` over a view remains symmetric.
        shifts: filled.
    """
    normal, inverse = np.empty((_PLANE, _PLANE)), np.empty((_PLANE, _PLANE))
    for view in range(len(shifts.variance)):
        if not _is_uncertain(shifts, view):
            continue
        offset, back = shifts.offset[view], shifts.back_substitution[view]
        normal[:], offset[:], back[:] = 0.0, 0.0, 0.0
        for k in range(len(view_of)):
            if view_of[k] == view:
                _add_ball_view(k, variances[k], equations, normal, offset, back)
        _fill_posterior(shifts.inverse_weight[view], shifts.variance[view], normal, inverse)
        x, y = offset
        offset[0] = inverse[0, 0] * x + inverse[0, 1] * y
        offset[1] = inverse[1, 0] * x + inverse[1, 1] * y
        for j in range(SHARED):
            x, y = back[0, j], back[1, j]
            back[0, j] = inverse[0, 0] * x + inverse[0, 1] * y
            back[1, j] = inverse[1, 0] * x + inverse[1, 1] * y
        for k in range(len(view_of)):
            if view_of[k] == view:
                _eliminate_from(k, variances[k], inverse, offset, back, equations)


@inlined
def _is_uncertain(shifts: ViewShifts, view: int) -> bool:
    return bool(shifts.variance[view, 0, 0] + shifts.variance[view, 1, 1] > 0)


@inlined
def _add_ball_view(
    k: int,
    variances: Floats,
    equations: ReducedEquations,
    normal: Floats,
    offset: Floats,
    back: Floats,
) -> None:
    """Add ball-view k's part to the equations (2, 2), (2,), (2, 7) of its view's shift."""
    for a in range(_PLANE):
        weight = 1 / variances[a]
        normal[a, a] += weight
        offset[a] += weight * equations.offset[k, a]
        for b in range(_PLANE):
            normal[a, b] -= weight * equations.effect_covariance[k, a, b] / variances[b]
        for j in range(SHARED):
            back[a, j] += weight * equations.back_substitution[k, a, j]


@inlined
def _fill_posterior(inverse_weight: float, prior: Floats, normal: Floats, out: Floats) -> None:
    """Fill ((w prior)^-1 + normal)^-1 (2, 2) with w = inverse_weight; the prior may be singular."""
    w = inverse_weight
    p, q, r = w * prior[0, 0], w * prior[0, 1], w * prior[1, 1]
    a, b = 1 + p * normal[0, 0] + q * normal[1, 0], p * normal[0, 1] + q * normal[1, 1]
    c, d = q * normal[0, 0] + r * normal[1, 0], 1 + q * normal[0, 1] + r * normal[1, 1]
    unit = 1 / (a * d - b * c)
    out[0, 0], out[0, 1] = unit * (d * p - b * q), unit * (d * q - b * r)
    out[1, 0], out[1, 1] = unit * (a * q - c * p), unit * (a * r - c * q)


@inlined
def _eliminate_from(
    k: int,
    variances: Floats,
    inverse: Floats,
    offset: Floats,
    back: Floats,
    equations: ReducedEquations,
) -> None:
    """Eliminate a view's shift from the equations of one of its ball-views.

    Args:
        variances: (3,) of its random effects.
        inverse: (2, 2) covariance of the view's shift, given the shared unknowns.
    """
    right, normal, effects = (
        equations.right[k],
        equations.normal[k],
        equations.effect_covariance[k],
    )
    for a in range(_PLANE):
        unit, off = 1 / variances[a], equations.offset[k, a]
        for i in range(SHARED):
            pull = unit * back[a, i]
            right[i] -= pull * off
            for j in range(SHARED):
                normal[i, j] -= pull * equations.back_substitution[k, a, j]
    # Derivatives of the random effects by the view's shift.
    lever = np.empty((EFFECTS, _PLANE))
    for a in range(EFFECTS):
        for b in range(_PLANE):
            lever[a, b] = (a == b) - effects[a, b] / variances[b]
    for a in range(EFFECTS):
        x, y = lever[a, 0], lever[a, 1]
        equations.offset[k, a] -= x * offset[0] + y * offset[1]
        for j in range(SHARED):
            equations.back_substitution[k, a, j] -= x * back[0, j] + y * back[1, j]
        p, q = x * inverse[0, 0] + y * inverse[1, 0], x * inverse[0, 1] + y * inverse[1, 1]
        for b in range(EFFECTS):
            effects[a, b] += p * lever[b, 0] + q * lever[b, 1]


@compiled
def update_view_shifts(step: Floats, shifts: ViewShifts) -> None:
    """Fill the views' shifts, given the step (6 + c,), and their weights (formulas 7 and 12)."""
    for view in range(len(shifts.variance)):
        if not _is_uncertain(shifts, view):
            continue
        square = 0.0
        for a in range(_PLANE):
            shift = shifts.offset[view, a] - shifts.back_substitution[view, a, 6] * step[6 + view]
            for j in range(6):
                shift -= shifts.back_substitution[view, a, j] * step[j]
            shifts.shift[view, a] = shift
            square += shift * shift
        square /= (shifts.variance[view, 0, 0] + shifts.variance[view, 1, 1]) / 2
        shifts.inverse_weight[view] = max(1.0, square / _MAX_SHIFT_SQUARE)


@compiled
def subtract_view_shifts(
    view_of: Ints, shifts: ViewShifts, by_effect: Floats, covariance: Floats
) -> None:
    """Subtract what the views' uncertain shifts add to a fitted pose's covariance (6, 6).

    `calibration_covariance` adds it back, with the correlations between a camera's balls.

    Args:
        view_of: (k,) index of the ball-views' views.
        by_effect: (k, 6, 3) derivatives of the pose by the ball-views' random effects.
    """
    for view in range(len(shifts.variance)):
        if _is_uncertain(shifts, view):
            lever = np.zeros((6, _PLANE))
            for k in range(len(view_of)):
                if view_of[k] == view:
                    lever += by_effect[k, :, :_PLANE]
            covariance -= lever @ shifts.variance[view] @ lever.T


_INITIAL_SD_PX = 3.0
"""Wide enough for any outline: with less, Tukey's weights would reject all points of one that is
shifted by several px."""
_PRIOR_SD_PX = 0.03  # Of a prior that is worth one ball-view
_MIN_SD_PX = 0.003
_MIN_RADIUS_SD_PX = 0.1
"""Balls are not round to better than this, and edges differ: a size determines range no better."""


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
    center = radius = _PRIOR_SD_PX**2
    known_center = known_radius = 1.0
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
    for k in range(len(inverse_weight)):
        distance = square[k] / variance[0]
        inverse_weight[k] = (STUDENT_DEGREES + distance) / (STUDENT_DEGREES + 2)


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
