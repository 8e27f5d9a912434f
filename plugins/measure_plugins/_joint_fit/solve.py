"""The joint fit of one pose to every outline point of every ball in every camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, folded
from measure.geometry.linear_kernels import invert_scaled
from measure.geometry.rotation_kernels import rotation_of, rotvec_of
from measure_plugins._joint_fit.elimination import (
    OWN,
    Aside,
    Terms,
    eliminate,
    empty_terms,
    own_unknowns,
    set_aside,
    take_back,
    update_aside,
)
from measure_plugins._joint_fit.problem import Contours
from measure_plugins._joint_fit.random_effects import (
    Scatter,
    free_scatter,
    own_variances,
    update_scatter,
)
from measure_plugins._joint_fit.residuals import COLUMNS, collect
from measure_plugins._joint_fit.sensitivity import by_camera, by_shift, by_step

_LOOKS = 15
_TURNS = 4
"""With the sums over the points at hand a turn costs a fifth of a look at the points."""
_LEAST_STEP = 0.1
"""In standard deviations by the outlines' own scatter: what is left then is a third of that."""
_SHRINKING, _FURTHER = 0.5, 1.4
"""Weights and scatter are those of the step before, and hold steps back: one that is less than half
as long as the one before leads on by some two thirds of what is left to go, and is lengthened. Not
where cameras are uncertain: their shifts follow the step, and points are weighed about those."""
_SETTLED_MM, _SETTLED_RAD = 2e-2, 3e-4
"""Steps below which a fit that ran out of looks still counts as settled."""
_SCATTER_SETTLED = 0.1
"""Relative change of a variance."""
_ILL_CONDITIONED = 1e12
_OFFSET_SD_PX = 3.0
"""A view's common edge offset is all but free; this only keeps a lone arc solvable."""


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


class _Balance(NamedTuple):
    """The state of a fit between two looks at the points; filled in place.

    Attributes:
        moments: (k, 10, 10) what the points say.
        terms: the same, the ball-views' own unknowns eliminated.
        known: (6 + c, 6 + c) information that does not come from the points.
        pull: (6 + c,) its right side.
        covariance: (6 + c, 6 + c) of pose and offsets.
        step: (6 + c,) from where the points were looked at.
        shifts: (k, 3) the own unknowns.
        variances: (k, 3) of those, as taken for `terms`.
        scatter: what those follow from, estimated anew.
        aside: what the views' own unknowns may be, and are.
    """

    moments: Floats
    terms: Terms
    known: Floats
    pull: Floats
    covariance: Floats
    step: Floats
    shifts: Floats
    variances: Floats
    scatter: Scatter
    aside: Aside


@folded
def fit_contours(
    contours: Contours,
    rotation: Floats,
    translation: Floats,
    prior_information: Floats,
    aside: Aside,
) -> ContourFit:
    """Fit the pose; Gauss-Newton with Tukey weights on points and random shifts of ball-views.

    The points are looked at as often as the pose moves or their weights change; how far ball-views
    are off settles in between.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of the world_from_body to start from, right to a few mm and degrees.
        translation: (3,) of the same.
        prior_information: (6, 6) of the start, for what the outlines leave open; zero for none.
        aside: what may shift the outlines of a view alike; its results are filled.
    """
    start_rotation, start_translation, gone = rotation, translation, np.zeros(6)
    offsets = np.zeros(len(contours.rotations))
    now, solved = _begin(len(contours.view_of), prior_information, aside), False
    before, exact = 0.0, not np.any(aside.variance)
    for look in range(_LOOKS):
        collect(contours, rotation, translation, offsets, now.shifts, now.moments)
        if look > 0:
            gone[:3] = translation - start_translation
            gone[3:] = rotvec_of(rotation @ start_rotation.T)
        _pull_back(prior_information, gone, offsets, now.pull)
        solved, standard = _settle(contours, now)
        if not solved:
            break
        if exact and standard < _SHRINKING * before:
            now.step[:] *= _FURTHER
        before = standard
        rotation, translation = rotation_of(now.step[3:6]) @ rotation, translation + now.step[:3]
        offsets = offsets + now.step[6:]
        if standard < _LEAST_STEP:
            break
    steps = by_step(contours, now.terms, now.covariance)
    reactions = by_shift(contours, now.terms, now.variances, now.covariance)
    covariance = now.covariance[:6, :6].copy()
    take_back(contours.view_of, aside, reactions, covariance)
    return ContourFit(
        rotation,
        translation,
        covariance,
        offsets,
        now.shifts,
        np.sqrt(now.scatter.variance[1:]),
        steps,
        by_camera(contours, steps, rotation, translation),
        reactions,
        solved,
        _within(now.step, _SETTLED_MM, _SETTLED_RAD),
    )


@compiled
def _begin(k: int, prior_information: Floats, aside: Aside) -> _Balance:
    """Of k ball-views."""
    c = len(aside.variance)
    known = np.zeros((6 + c, 6 + c))
    known[:6, :6] = prior_information
    for view in range(c):
        known[6 + view, 6 + view] = 1 / _OFFSET_SD_PX**2
    return _Balance(
        np.empty((k, COLUMNS, COLUMNS)),
        empty_terms(k),
        known,
        np.zeros(6 + c),
        np.zeros((6 + c, 6 + c)),
        np.full(6 + c, np.inf),
        np.zeros((k, OWN)),
        np.zeros((k, OWN)),
        free_scatter(k),
        aside,
    )


@compiled
def _pull_back(prior_information: Floats, gone: Floats, offsets: Floats, out: Floats) -> None:
    """Fill the right side (6 + c,) of what is known besides the points."""
    for i in range(6):
        out[i] = 0.0
        for j in range(6):
            out[i] -= prior_information[i, j] * gone[j]
    for view in range(len(offsets)):
        out[6 + view] = -offsets[view] / _OFFSET_SD_PX**2


@compiled
def _within(step: Floats, limit_mm: float, limit_rad: float) -> bool:
    return np.max(np.abs(step[:3])) < limit_mm and np.max(np.abs(step[3:6])) < limit_rad


@compiled
def _settle(contours: Contours, now: _Balance) -> tuple[bool, float]:
    """Find the step and the scatter that go together.

    Returns:
        Whether the outlines determine the pose, and the step in standard deviations.
    """
    normal, right, square = np.empty_like(now.known), np.empty_like(now.pull), np.inf
    for _ in range(_TURNS):
        own_variances(contours, now.scatter, now.variances)
        eliminate(now.moments, now.variances, now.terms)
        set_aside(contours.view_of, now.variances, now.terms, now.aside)
        _add_up(contours, now, normal, right)
        if not invert_scaled(normal, now.covariance) < _ILL_CONDITIONED:
            return False, np.inf
        square = 0.0
        for i in range(len(right)):
            now.step[i] = 0.0
            for j in range(len(right)):
                now.step[i] += now.covariance[i, j] * right[j]
            square += now.step[i] * right[i]
        own_unknowns(contours.view_of, now.terms, now.step, now.shifts)
        update_aside(now.step, now.aside)
        before = now.scatter.variance[0]
        update_scatter(contours, now.terms, now.covariance, now.shifts, now.variances, now.scatter)
        if abs(now.scatter.variance[0] - before) <= _SCATTER_SETTLED * before:
            break
    for k in range(len(now.shifts)):
        now.shifts[k, :2] += now.aside.shift[contours.view_of[k]]
    return True, np.sqrt(square)


@compiled
def _add_up(contours: Contours, now: _Balance, normal: Floats, right: Floats) -> None:
    """Fill the normal matrix (6 + c, 6 + c), of which the lower half counts, and right side."""
    terms = now.terms
    normal[:], right[:] = now.known, now.pull
    for k in range(len(contours.view_of)):
        offset = 6 + contours.view_of[k]
        for i in range(6):
            right[i] += terms.right[k, i]
            normal[offset, i] += terms.normal[k, 6, i]
            for j in range(i + 1):
                normal[i, j] += terms.normal[k, i, j]
        right[offset] += terms.right[k, 6]
        normal[offset, offset] += terms.normal[k, 6, 6]
