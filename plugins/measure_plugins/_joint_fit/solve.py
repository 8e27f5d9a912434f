"""The joint fit of one pose to every outline point of every ball in every camera.

Its covariance holds random effects, light, and calibration, by the derivatives of the pose by what
it was fitted to (docs/explanation/joint_fit.md, formulas 17 and 19). Everywhere k ball-views in c
views show some of a body's b balls, ball-view i ball `ball_of[i]`; the lens rows are (c, 16).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, folded
from measure.geometry.kernels import apply_matrix, invert_scaled, rotation_of, rotvec_of
from measure.model.camera_rows import RigRows
from measure.model.projection import by_cameras, project_rows
from measure_plugins._joint_fit import elimination
from measure_plugins._joint_fit.elimination import prior_view_shifts
from measure_plugins._joint_fit.outlines import COLUMNS, PackedOutlines, accumulate_moments

_MAX_ITERATIONS = 15
_MAX_INNER_ITERATIONS = 4
"""Of the effects' variances, at fixed moments: one costs a fifth of forming the moments."""
_CONVERGED_SD = 0.1
"""Step, in standard deviations of the pose, below which the fit has converged; a third of that is
left to go."""
_FAST_STEP_RATIO, _OVER_RELAXATION = 0.5, 1.4
"""Weights and variances are those of the iteration before, which shortens the steps: one of less
than half the length of the one before covers some two thirds of what is left, and is multiplied by
1.4. Not where cameras are uncertain: their shifts follow the step, and the points' weights
those."""
_CONVERGED_MM, _CONVERGED_RAD = 2e-2, 3e-4
"""Steps below which a fit that ran out of iterations still counts as converged."""
_VARIANCE_CONVERGED_RATIO = 0.1
"""Relative change of the effects' variance that ends the inner iterations."""
_MAX_VARIANCE_INFLATION = 1e12
_OFFSET_SD_PX = 3.0
"""Prior of a view's edge offset: wide, and there so that a single short arc can be solved."""


class Start(NamedTuple):
    """The world_from_body that a fit starts from, right to a few mm and degrees."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,) mm
    information: Floats  # (6, 6) for what the outlines leave open; zero for none


class OutlineFit(NamedTuple):
    """The result of the joint fit, before what all outlines have in common is added."""

    rotation: Floats  # (3, 3) of world_from_body
    translation: Floats  # (3,) of world_from_body, mm
    covariance: Floats  # (6, 6) without the cameras' own uncertainty
    offsets_px: Floats  # (c,) outward edge offset of every view
    effects_px: Floats  # (k, 3) random effects bx, by, br, with the view's shift in bx and by
    effect_sd_px: Floats  # (2,) estimated standard deviations of bx and by (each), and of br
    by_ball: Floats  # (k, 6, 3) derivatives of the pose by where a ball-view shows its ball, per mm
    by_camera: Floats  # (c, 6, 6) derivatives by the cameras' poses, in their `perturb` charts
    by_effect: Floats  # (k, 6, 3) derivatives by shifts (x, y, radius) of an outline, per px
    solved: bool
    converged: bool


class _FitState(NamedTuple):
    """The state of a fit at fixed moments; filled in place."""

    moments: Floats  # (k, 10, 10) see `residuals.accumulate_moments`
    equations: elimination.ReducedEquations  # the same, the random effects eliminated
    prior_normal: Floats  # (6 + c, 6 + c) information that does not come from the points
    prior_right: Floats  # (6 + c,) its right side
    covariance: Floats  # (6 + c, 6 + c) of pose and edge offsets
    step: Floats  # (6 + c,) from where the moments were formed
    effects: Floats  # (k, 3) the random effects
    variances: Floats  # (k, 3) of those, as used in `equations`
    effect_variance: elimination.EffectVariance  # the estimate that `variances` are made of
    view_shifts: elimination.ViewShifts


@compiled
def fit_outlines(
    outlines: PackedOutlines, start: Start, view_shifts: elimination.ViewShifts
) -> OutlineFit:
    """Fit the pose: Gauss-Newton with Tukey weights on points and random effects of ball-views.

    Every iteration forms the moments of the points about the pose, and then alternates, at fixed
    moments, between the step and the variances of the random effects: "Iterations" in
    docs/explanation/joint_fit.md.

    Args:
        view_shifts: of the views, with their variances; the estimates are filled.
    """
    rotation, translation, gone = start.rotation, start.translation, np.zeros(6)
    offsets = np.zeros(len(outlines.rotations))
    state, solved = _initial_state(len(outlines.view_of), start.information, view_shifts), False
    before, exact = 0.0, not np.any(view_shifts.variance)
    for iteration in range(_MAX_ITERATIONS):
        accumulate_moments(outlines, rotation, translation, offsets, state.effects, state.moments)
        if iteration > 0:
            gone[:3] = translation - start.translation
            gone[3:] = rotvec_of(rotation @ start.rotation.T)
        _fill_prior_right(start.information, gone, offsets, state.prior_right)
        solved, step_sd = _solve_inner(outlines, state)
        if not solved:
            break
        if exact and step_sd < _FAST_STEP_RATIO * before:
            state.step[:] *= _OVER_RELAXATION
        before = step_sd
        rotation = rotation_of(state.step[3:6]) @ rotation
        translation = translation + state.step[:3]
        offsets = offsets + state.step[6:]
        if step_sd < _CONVERGED_SD:
            break
    return _fitted(outlines, state, rotation, translation, offsets, solved)


@folded
def _fitted(
    outlines: PackedOutlines,
    state: _FitState,
    rotation: Floats,
    translation: Floats,
    offsets: Floats,
    solved: bool,
) -> OutlineFit:
    """The result, from the last state."""
    steps = by_ball(outlines, state.equations, state.covariance)
    reactions = by_effect(outlines, state.equations, state.variances, state.covariance)
    covariance = state.covariance[:6, :6].copy()
    elimination.subtract_view_shifts(outlines.view_of, state.view_shifts, reactions, covariance)
    return OutlineFit(
        rotation,
        translation,
        covariance,
        offsets,
        state.effects,
        np.sqrt(state.effect_variance.variance[1:]),
        steps,
        by_camera(outlines, steps, rotation, translation),
        reactions,
        solved,
        _within(state.step, _CONVERGED_MM, _CONVERGED_RAD),
    )


@compiled
def _initial_state(
    k: int, prior_information: Floats, view_shifts: elimination.ViewShifts
) -> _FitState:
    """Of k ball-views."""
    c = len(view_shifts.variance)
    prior_normal = np.zeros((6 + c, 6 + c))
    prior_normal[:6, :6] = prior_information
    for view in range(c):
        prior_normal[6 + view, 6 + view] = 1 / _OFFSET_SD_PX**2
    return _FitState(
        np.empty((k, COLUMNS, COLUMNS)),
        elimination.empty_equations(k),
        prior_normal,
        np.zeros(6 + c),
        np.zeros((6 + c, 6 + c)),
        np.full(6 + c, np.inf),
        np.zeros((k, elimination.EFFECTS)),
        np.zeros((k, elimination.EFFECTS)),
        elimination.initial_effect_variance(k),
        view_shifts,
    )


@compiled
def _fill_prior_right(
    prior_information: Floats, gone: Floats, offsets: Floats, out: Floats
) -> None:
    """Fill the prior's right side (6 + c,) after a motion `gone` (6,) from the start."""
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
def _solve_inner(outlines: PackedOutlines, state: _FitState) -> tuple[bool, float]:
    """Alternate between the step and the effects' variances, at fixed moments."""
    normal, right = np.empty_like(state.prior_normal), np.empty_like(state.prior_right)
    square = np.inf
    for _ in range(_MAX_INNER_ITERATIONS):
        elimination.fill_effect_variances(outlines, state.effect_variance, state.variances)
        elimination.eliminate(state.moments, state.variances, state.equations)
        elimination.eliminate_view_shifts(
            outlines.view_of, state.variances, state.equations, state.view_shifts
        )
        _assemble(outlines, state, normal, right)
        if not invert_scaled(normal, state.covariance) < _MAX_VARIANCE_INFLATION:
            return False, np.inf
        square = 0.0
        for i in range(len(right)):
            state.step[i] = 0.0
            for j in range(len(right)):
                state.step[i] += state.covariance[i, j] * right[j]
            square += state.step[i] * right[i]
        elimination.back_substitute(outlines.view_of, state.equations, state.step, state.effects)
        elimination.update_view_shifts(state.step, state.view_shifts)
        before = state.effect_variance.variance[0]
        elimination.update_effect_variance(
            outlines,
            state.equations,
            state.covariance,
            state.effects,
            state.variances,
            state.effect_variance,
        )
        if abs(state.effect_variance.variance[0] - before) <= _VARIANCE_CONVERGED_RATIO * before:
            break
    for k in range(len(state.effects)):
        state.effects[k, :2] += state.view_shifts.shift[outlines.view_of[k]]
    return True, np.sqrt(square)


@compiled
def _assemble(outlines: PackedOutlines, state: _FitState, normal: Floats, right: Floats) -> None:
    """Fill the normal matrix (6 + c, 6 + c), its lower half only, and right side."""
    equations = state.equations
    normal[:], right[:] = state.prior_normal, state.prior_right
    for k in range(len(outlines.view_of)):
        offset = 6 + outlines.view_of[k]
        for i in range(6):
            right[i] += equations.right[k, i]
            normal[offset, i] += equations.normal[k, 6, i]
            for j in range(i + 1):
                normal[i, j] += equations.normal[k, i, j]
        right[offset] += equations.right[k, 6]
        normal[offset, offset] += equations.normal[k, 6, 6]


@compiled
def by_ball(
    outlines: PackedOutlines, equations: elimination.ReducedEquations, inverse: Floats
) -> Floats:
    """Derivatives (k, 6, 3) of the pose by where single ball-views show their balls, world, per mm.

    A step of the ball changes the residuals of its ball-view as the same step of the body does.
    """
    out = np.empty((len(outlines.view_of), 6, 3))
    for k in range(len(out)):
        _fill_solution(inverse, 6 + outlines.view_of[k], equations.normal[k, :, :3], out[k])
    return out


@compiled
def _fill_solution(inverse: Floats, offset: int, right: Floats, out: Floats) -> None:
    """Fill the pose (6, 3) that solves for a ball-view's right sides (7, 3)."""
    for i in range(6):
        for j in range(3):
            total = inverse[i, offset] * right[6, j]
            for b in range(6):
                total += inverse[i, b] * right[b, j]
            out[i, j] = total


@compiled
def by_camera(
    outlines: PackedOutlines, steps: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Derivatives (c, 6, 6) of the pose by the cameras' poses, in their `perturb` charts.

    Moving a camera by (dt, w) moves every ball, as the camera sees it, by -dt - w x (X - t).
    """
    out = np.zeros((len(outlines.rotations), 6, 6))
    for k in range(len(outlines.view_of)):
        view = outlines.view_of[k]
        outward = outlines.rotations[view].T
        # From the camera's centre to the ball's.
        x, y, z = (
            apply_matrix(rotation, outlines.centers_body[k])
            + translation
            + apply_matrix(outward, outlines.translations[view])
        )
        for i in range(6):
            p, q, r = steps[k, i]
            out[view, i, 0] += p
            out[view, i, 1] += q
            out[view, i, 2] += r
            out[view, i, 3] -= q * z - r * y
            out[view, i, 4] -= r * x - p * z
            out[view, i, 5] -= p * y - q * x
    return out


@compiled
def by_effect(
    outlines: PackedOutlines,
    equations: elimination.ReducedEquations,
    variances: Floats,
    inverse: Floats,
) -> Floats:
    """Derivatives (k, 6, 3) of the pose by shifts (x, y, radius) of single outlines, per px.

    A shift s leaves, the ball-view's random effects eliminated, the right side B^T (s / variance)
    with B = `back_substitution`.
    """
    out = np.empty((len(outlines.view_of), 6, elimination.EFFECTS))
    right = np.empty((elimination.SHARED, elimination.EFFECTS))
    for k in range(len(out)):
        for a in range(elimination.SHARED):
            for j in range(elimination.EFFECTS):
                right[a, j] = equations.back_substitution[k, j, a] / variances[k, j]
        _fill_solution(inverse, 6 + outlines.view_of[k], right, out[k])
    return out


_COMMON_SHIFT_PX = 0.05
"""Standard deviation of a ball's shift by light that all cameras share, however well they agree:
chosen on rendered recordings so that the normalised squared error is near one. Neither the scatter
of outlines nor how far the correction moves them predicts it (docs/explanation/research_log.md)."""
_PER_BALL_SHARE = 0.4
"""Share of that variance that is independent from ball to ball; as much again is common to all
balls, and moves the body without turning it. With independent shifts alone the stated variance of
the position would be too small beside the rotation's, the more so the more balls there are."""


class UncertainBalls(NamedTuple):
    """How far b balls may be from spheres of their radii."""

    radius_covariance: Floats  # (b, b) of the radii, mm^2
    shape_variances: Floats  # (3,) of an outline's x, y and radius by a ball out of round, mm^2


class JointFit(NamedTuple):
    """A pose fitted to outlines, with its full covariance."""

    found: OutlineFit
    covariance: Floats  # (6, 6) in the `perturb` chart: random effects, light, and calibration
    by_camera: Floats  # (c, 6, 18) by the poses and intrinsics of uncertain cameras
    rms_px: float  # of the effects bx and by


def solve_outlines(
    outlines: PackedOutlines,
    start: Start,
    ball_of: Ints,
    balls: UncertainBalls,
    rig: RigRows,
    view_noise: Floats,
    widening: float,
) -> JointFit:
    """Fit the pose, see `fit_outlines`, and propagate all that is uncertain about it.

    See docs/explanation/joint_fit.md, formula 15.

    Args:
        view_noise: (c, 2, 2) covariances of the views' shifts by their calibration, px^2.
        widening: factor of the covariance, for effects whose variance is itself estimated.
    """
    fit = fit_outlines(outlines, start, prior_view_shifts(view_noise))
    known, levers = fit.covariance * widening, np.zeros((len(rig.lenses), 6, 18))
    if fit.solved:
        seen = _SeenBalls.of(outlines, fit, rig)
        known = known + light_covariance(seen, fit, ball_of)
        by_radius = pose_by_radius(seen, fit, ball_of, len(balls.radius_covariance))
        known += by_radius @ balls.radius_covariance @ by_radius.T
        known += shape_covariance(seen, fit, balls.shape_variances)
        levers = camera_levers(outlines, fit, rig, seen)
        known += np.einsum("cik,ckl,cjl->ij", levers, rig.covariances, levers)
    off = fit.effects_px[:, :2]
    return JointFit(fit, (known + known.T) / 2, levers, float(np.sqrt(np.sum(off**2) / len(off))))


class _SeenBalls(NamedTuple):
    """The balls of k ball-views where the fit puts them."""

    centers: Floats  # (k, 3) in the camera frame, mm
    focal_px: Floats  # (k,)
    distance_mm: Floats  # (k,)
    px_per_mm: Floats  # (k,) how far an outline moves in its picture if the ball's surface does

    @classmethod
    def of(cls, outlines: PackedOutlines, fit: OutlineFit, rig: RigRows) -> _SeenBalls:
        """Those of a fit."""
        view, lens = outlines.view_of, rig.lenses[outlines.view_of]
        places = outlines.centers_body @ fit.rotation.T + fit.translation
        centers = np.einsum("kij,kj->ki", outlines.rotations[view], places)
        centers += outlines.translations[view]
        focal_px, square = (lens[:, 0] + lens[:, 3]) / 2, np.sum(centers**2, axis=1)
        px_per_mm = focal_px / np.sqrt(square - outlines.radii**2)
        return cls(centers, focal_px, np.sqrt(square), px_per_mm)


def camera_levers(
    outlines: PackedOutlines, fit: OutlineFit, rig: RigRows, seen: _SeenBalls
) -> Floats:
    """Derivatives (c, 6, 18) of the pose by the uncertain cameras' poses and intrinsics.

    See docs/explanation/joint_fit.md, formula 19.
    """
    levers = np.zeros((len(rig.lenses), 6, 18))
    uncertain = rig.covariances.any(axis=(1, 2))
    if uncertain.any():
        levers[:, :, :6] = fit.by_camera
        by_intrinsics = _outlines_by_lens(outlines, rig, seen)
        np.subtract.at(levers[:, :, 6:], outlines.view_of, fit.by_effect @ by_intrinsics)
        levers[~uncertain] = 0.0
    return levers


_EDGES = np.array([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
"""A ball's centre, and the ends of its diameters along the picture's axes, in radii."""


def _outlines_by_lens(outlines: PackedOutlines, rig: RigRows, seen: _SeenBalls) -> Floats:
    """Derivatives (k, 3, 12) of the outlines (x, y, radius) by the intrinsics."""
    view, count = np.repeat(outlines.view_of, len(_EDGES)), len(outlines.view_of)
    points = seen.centers[:, None] + outlines.radii[:, None, None] * _EDGES
    still, here = np.zeros((len(view), 3)), np.tile(np.eye(3), (len(view), 1, 1))
    rows = RigRows(rig.lenses[view], np.full(len(view), np.inf), here, still, rig.covariances[view])
    at, moved = points.reshape(-1, 3), np.empty((count, 3, 12))
    pixels = project_rows(rows, at)[0].reshape(count, -1, 2)
    by_lens = by_cameras(rows, at)[..., 6:].reshape(count, -1, 2, 12)
    outward = pixels[:, 1:] - pixels[:, :1]
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    moved[:, :2] = by_lens[:, 0]
    moved[:, 2] = np.einsum("kea,keaj->kj", outward, by_lens[:, 1:] - by_lens[:, :1]) / 4
    return moved


def pose_by_radius(seen: _SeenBalls, fit: OutlineFit, ball_of: Ints, balls: int) -> Floats:
    """Derivatives (6, b) of the pose by the balls' radii, per mm.

    A ball that is larger has larger outlines in all views. See docs/explanation/joint_fit.md,
    formula 22.
    """
    out = np.zeros((balls, 6))
    np.add.at(out, ball_of, fit.by_effect[:, :, 2] * seen.px_per_mm[:, None])
    return out.T


def shape_covariance(seen: _SeenBalls, fit: OutlineFit, variances: Floats) -> Floats:
    """What balls that are out of round add to the pose's covariance (6, 6).

    Each view shows another outline of a ball, which shifts and grows independently: as random
    effects do, whose covariance the fit states. What is missing there is added. See
    docs/explanation/joint_fit.md, formula 23.

    Args:
        variances: (3,) of an outline's x, y and radius, mm^2.
    """
    stated = fit.effect_sd_px[[0, 0, 1]] ** 2
    missing = np.maximum(variances * seen.px_per_mm[:, None] ** 2 - stated, 0.0)
    return np.einsum("kie,ke,kje->ij", fit.by_effect, missing, fit.by_effect)


def light_covariance(seen: _SeenBalls, fit: OutlineFit, ball_of: Ints) -> Floats:
    """What shifts of a ball that all cameras share add to the pose's covariance (6, 6).

    Light falls on a ball from the same side for all cameras and shifts its outlines: the part of
    the shift that they share moves the ball and leaves no residual. Partly it is independent from
    ball to ball, and partly the same for all balls, as an error of the tone curve is for balls
    under the same light. See docs/explanation/joint_fit.md, formula 18.
    """
    levers = np.zeros((int(np.max(ball_of)) + 1, 6, 3))
    np.add.at(levers, ball_of, fit.by_ball)
    together = levers.sum(axis=0)
    out = np.einsum("bik,bjk->ij", levers, levers) + together @ together.T
    common_mm = _COMMON_SHIFT_PX * float(np.mean(seen.distance_mm / seen.focal_px))
    return np.asarray(out * (_PER_BALL_SHARE * common_mm**2))
