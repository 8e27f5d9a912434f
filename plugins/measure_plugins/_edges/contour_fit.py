"""The joint fit of one pose to every outline point of every ball in every camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import rotation_of, rotvec_of
from measure_plugins._edges.contour_reactions import by_camera, by_shift, by_step
from measure_plugins._edges.contour_terms import OWN, Terms, collect, empty_terms
from measure_plugins._edges.contours import Contours
from measure_plugins._edges.linear import cholesky, solve_factored
from measure_plugins._edges.selection import median

_STEPS = 15
_STEP_MM, _STEP_RAD = 5e-4, 1e-5
"""A hundredth of what the best pictures allow."""
_SETTLED_MM, _SETTLED_RAD = 2e-2, 3e-4
"""Steps below which a fit that ran out of turns still counts as settled."""
_ILL_CONDITIONED = 1e12
_OFFSET_SD_PX = 3.0
"""A view's common edge offset is all but free; this only keeps a lone arc solvable."""
_SCATTER_START_PX = 3.0
"""Outlines are free to sit anywhere at first: else one that does takes all its points for bad."""
_SCATTER_SETTLED = 0.1
_SCATTER_PRIOR_PX = 0.03
_SCATTER_PRIOR_COUNT = 1.0
_SCATTER_FLOOR_PX = 0.003
_TAILS = 4.0
"""Degrees of freedom of the ball-views' shifts, a few of which are several times the others'."""
_GROSS = 5.0
_LEAST_TYPICAL_PX = 0.2
"""Ball-views off by more than so many typical standard deviations must not raise the variance. Off
by half a pixel they are no strangers: what light shifts in one camera it shifts back in another."""
_RADIUS_SCATTER_FLOOR_PX = 0.1
"""Balls are not round to better than this, and their edges differ: sizes never tell range finer."""


class ContourFit(NamedTuple):
    """What the joint fit found.

    Attributes:
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body, mm.
        covariance: (6, 6) without the cameras' own uncertainty.
        offsets_px: (c,) outward edge offset of every view.
        shifts_px: (k, 3) of each ball-view: x, y and radius by which its outline sits off.
        shift_sd_px: (2,) estimated scatter of those: centre (per axis) and radius.
        by_step: (k, 6, 3) how the pose reacts if a ball-view shows its ball elsewhere, per mm of
            the world's axes.
        by_camera: (c, 6, 6) how the pose reacts to each camera's pose, in their `perturb` charts.
        by_shift: (k, 6, 3) how the pose reacts to what shifts a ball-view's outline, per px.
        solved: whether the outlines determine the pose.
        converged: whether the steps died out.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats
    offsets_px: Floats
    shifts_px: Floats
    shift_sd_px: Floats
    by_step: Floats
    by_camera: Floats
    by_shift: Floats
    solved: bool
    converged: bool


@compiled
def fit_contours(
    contours: Contours, rotation: Floats, translation: Floats, prior_information: Floats
) -> ContourFit:
    """Fit the pose; Gauss-Newton with Tukey weights on points and random shifts of ball-views.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of the world_from_body to start from, right to a few mm and degrees.
        translation: (3,) of the same.
        prior_information: (6, 6) of the start, for what the outlines leave open; zero for none.
    """
    k, c = len(contours.view_of), len(contours.rotations)
    start_rotation, start_translation = rotation, translation
    offsets, shifts, step = np.zeros(c), np.zeros((k, OWN)), np.full(6 + c, np.inf)
    scatter, doubt = np.full(OWN, _SCATTER_START_PX**2), np.ones(k)
    terms, covariance, solved = empty_terms(k), np.zeros((6 + c, 6 + c)), False
    for _ in range(_STEPS):
        variances = _variances(contours, scatter, doubt)
        collect(contours, rotation, translation, offsets, shifts, variances, terms)
        normal, right = _equations(contours, terms, offsets)
        if np.any(prior_information != 0):
            gone = np.empty(6)
            gone[:3] = translation - start_translation
            gone[3:] = rotvec_of(rotation @ start_rotation.T)
            normal[:6, :6] += prior_information
            right[:6] -= prior_information @ gone
        covariance, solved = _inverse(normal)
        if not solved:
            break
        step = covariance @ right
        shifts = _own_steps(contours, terms, step)
        before = scatter[0]
        scatter, doubt = _scatter(contours, terms, covariance, shifts, variances, doubt)
        rotation, translation = rotation_of(step[3:6]) @ rotation, translation + step[:3]
        offsets = offsets + step[6:]
        changed = abs(scatter[0] - before) > _SCATTER_SETTLED * before
        if not changed and _within(step, _STEP_MM, _STEP_RAD):
            break
    variances = _variances(contours, scatter, doubt)
    collect(contours, rotation, translation, offsets, shifts, variances, terms)
    normal, _ = _equations(contours, terms, offsets)
    normal[:6, :6] += prior_information
    inverse, _ = _inverse(normal)
    steps = by_step(contours, terms, inverse)
    return ContourFit(
        rotation,
        translation,
        covariance[:6, :6].copy(),
        offsets,
        shifts,
        np.sqrt(scatter[1:]),
        steps,
        by_camera(contours, steps, rotation, translation),
        by_shift(contours, terms, variances, inverse),
        solved,
        _within(step, _SETTLED_MM, _SETTLED_RAD),
    )


@compiled
def _within(step: Floats, limit_mm: float, limit_rad: float) -> bool:
    return np.max(np.abs(step[:3])) < limit_mm and np.max(np.abs(step[3:6])) < limit_rad


@compiled
def _equations(contours: Contours, terms: Terms, offsets: Floats) -> tuple[Floats, Floats]:
    """Normal matrix (6 + c, 6 + c) and right side of the pose and the views' offsets."""
    count = 6 + len(offsets)
    normal, right = np.zeros((count, count)), np.zeros(count)
    for view in range(len(offsets)):
        normal[6 + view, 6 + view] = 1 / _OFFSET_SD_PX**2
        right[6 + view] = -offsets[view] / _OFFSET_SD_PX**2
    half = np.empty((4, 6))
    for k in range(len(contours.view_of)):
        _add_terms(terms, k, 6 + contours.view_of[k], half, normal, right)
    return normal, right


@compiled
def _add_terms(
    terms: Terms, k: int, offset: int, half: Floats, normal: Floats, right: Floats
) -> None:
    """Add ball-view k's terms; its centre moves by its arms, its view's offset is a row alone."""
    arms, own = terms.arms, terms.normal
    for a in range(4):
        x, y, z = own[k, a, 0], own[k, a, 1], own[k, a, 2]
        for j in range(6):
            half[a, j] = x * arms[k, 0, j] + y * arms[k, 1, j] + z * arms[k, 2, j]
    for i in range(6):
        for a in range(3):
            arm = arms[k, a, i]
            right[i] += arm * terms.right[k, a]
            for j in range(6):
                normal[i, j] += arm * half[a, j]
        normal[offset, i] += half[3, i]
        normal[i, offset] += half[3, i]
    normal[offset, offset] += own[k, 3, 3]
    right[offset] += terms.right[k, 3]


@compiled
def _inverse(normal: Floats) -> tuple[Floats, bool]:
    """The inverse of a normal matrix, and whether the equations determine their unknowns."""
    n = len(normal)
    size = np.sqrt(np.diag(normal))
    inverse, factor, unit = np.zeros((n, n)), np.empty((n, n)), np.zeros(n)
    if not np.all(size > 0) or not np.all(np.isfinite(normal)):
        return inverse, False
    if not cholesky(normal / np.outer(size, size), factor):
        return inverse, False
    for i in range(n):
        unit[i] = 1.0
        solve_factored(factor, unit, inverse[i])
        unit[i] = 0.0
    solved = np.all(np.isfinite(inverse)) and np.max(np.diag(inverse)) < _ILL_CONDITIONED
    return inverse / np.outer(size, size), bool(solved)


@compiled
def _own_steps(contours: Contours, terms: Terms, step: Floats) -> Floats:
    """The ball-views' own unknowns (k, 3), given the step of the shared ones."""
    out = np.empty((len(contours.view_of), OWN))
    shared = np.empty(4)
    for k in range(len(out)):
        for a in range(3):
            shared[a] = 0.0
            for j in range(6):
                shared[a] += terms.arms[k, a, j] * step[j]
        shared[3] = step[6 + contours.view_of[k]]
        for a in range(OWN):
            w, x, y, z = terms.gain[k, a]
            taken = w * shared[0] + x * shared[1] + y * shared[2] + z * shared[3]
            out[k, a] = terms.offset[k, a] - taken
    return out


@compiled
def _variances(contours: Contours, scatter: Floats, doubt: Floats) -> Floats:
    """Variances (k, 3) of the ball-views' own shifts."""
    out = np.empty((len(doubt), OWN))
    for k in range(len(doubt)):
        out[k, :2] = doubt[k] * contours.spread[k] * scatter[:2]
        out[k, 2] = doubt[k] * scatter[2]
    return out


@compiled
def _scatter(
    contours: Contours,
    terms: Terms,
    covariance: Floats,
    shifts: Floats,
    variances: Floats,
    doubt: Floats,
) -> tuple[Floats, Floats]:
    """Variances (3,) of the ball-views' shifts by restricted maximum likelihood, and doubts (k,).

    The fixed point v = sum(b^2) / sum(1 - posterior variance / v) is MacKay's (1992) for random
    effects; the posterior variances hold the uncertainty of the shared unknowns, which makes it the
    restricted likelihood's (Laird and Ware 1982). The centres' shifts are Student's: the doubts are
    the inverse weights of Lange, Little and Taylor (1989).
    """
    prior = _SCATTER_PRIOR_COUNT * _SCATTER_PRIOR_PX**2
    center, known_center = prior, _SCATTER_PRIOR_COUNT
    radius, known_radius = prior, _SCATTER_PRIOR_COUNT
    apart, reach, arms = np.empty(len(doubt)), np.empty(7), terms.arms
    for k in range(len(doubt)):
        for a in range(OWN):
            x, y, z = terms.gain[k, a, 0], terms.gain[k, a, 1], terms.gain[k, a, 2]
            for j in range(6):
                reach[j] = x * arms[k, 0, j] + y * arms[k, 1, j] + z * arms[k, 2, j]
            reach[6] = terms.gain[k, a, 3]
            spread = terms.own_covariance[k, a, a]
            spread += _variance(reach, covariance, 6 + contours.view_of[k])
            known = min(max(1 - spread / variances[k, a], 0.02), 1.0)
            if a < 2:
                center += shifts[k, a] ** 2 / (doubt[k] * contours.spread[k])
                known_center += known
            else:
                radius += shifts[k, a] ** 2 / doubt[k]
                known_radius += known
        apart[k] = (shifts[k, 0] ** 2 + shifts[k, 1] ** 2) / contours.spread[k]
    out = np.empty(OWN)
    out[:2] = max(center / known_center, _SCATTER_FLOOR_PX**2)
    out[2] = max(radius / known_radius, _RADIUS_SCATTER_FLOOR_PX**2)
    typical = max(median(apart.copy(), len(apart)) / 1.386, _LEAST_TYPICAL_PX**2)
    gross = (apart / (_GROSS**2 * typical)) ** 2
    return out, np.maximum(gross, (_TAILS + apart / out[0]) / (_TAILS + 2))


@compiled
def _variance(reach: Floats, covariance: Floats, offset: int) -> float:
    """Variance of `reach` (7,) times the pose and one offset, whose row of `covariance` is told."""
    total = reach[6] ** 2 * covariance[offset, offset]
    for i in range(6):
        total += 2 * reach[6] * reach[i] * covariance[offset, i]
        for j in range(6):
            total += reach[i] * reach[j] * covariance[i, j]
    return float(total)
