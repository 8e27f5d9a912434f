"""The jointly fitted pose with its covariance: random effects, light, and calibration.

Everywhere k ball-views in c views show some of a body's b balls, ball-view i ball `ball_of[i]`; the
lens rows are (c, 16).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.geometry.rotation_kernels import apply_matrix
from measure.model.lens import by_lens, to_pixel
from measure.model.rig import RigRows
from measure_plugins._joint_fit.elimination import prior_view_shifts
from measure_plugins._joint_fit.problem import PackedOutlines
from measure_plugins._joint_fit.solve import OutlineFit, Start, fit_outlines

_MIN_COMMON_SHIFT_PX = 0.06
"""Least standard deviation of a ball's shift by light that all cameras share, however well they
agree: chosen on rendered recordings, dim rooms and large lamps among them, so that 95 % regions
hold the truth in 95 %."""
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


@compiled
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
        count = len(balls.radius_covariance)
        known += light_covariance(outlines, fit, ball_of, count, rig.lenses)
        by_radius = pose_by_radius(outlines, fit, ball_of, count, rig.lenses)
        known += by_radius @ balls.radius_covariance @ by_radius.T
        known += shape_covariance(outlines, fit, balls.shape_variances, rig.lenses)
        levers = by_cameras(outlines, fit, rig)
        known += calibration_covariance(levers, rig)
    off = fit.effects_px[:, :2]
    return JointFit(fit, (known + known.T) / 2, levers, np.sqrt(np.sum(off * off) / len(off)))


@compiled
def rms_distance(fit: OutlineFit, points_body: Floats, centers: Floats) -> float:
    """RMS distance in mm of centres (f, 3) in the world from the body's (f, 3); NaN for f = 0."""
    total = 0.0
    for i in range(len(centers)):
        off = centers[i] - apply_matrix(fit.rotation, points_body[i]) - fit.translation
        total += np.sum(off * off)
    return float(np.sqrt(total / len(centers)))


@compiled
def calibration_covariance(levers: Floats, rig: RigRows) -> Floats:
    """What uncertain cameras add to the pose's covariance (6, 6), by the levers of `by_cameras`.

    See docs/explanation/joint_fit.md, formula 19.
    """
    out = np.zeros((6, 6))
    for view in range(len(rig.lenses)):
        if np.any(rig.covariances[view]):
            out += levers[view] @ rig.covariances[view] @ levers[view].T
    return out


@compiled
def by_cameras(outlines: PackedOutlines, fit: OutlineFit, rig: RigRows) -> Floats:
    """Derivatives (c, 6, 18) of the pose by the uncertain cameras' poses and intrinsics."""
    levers, by_intrinsics = np.zeros((len(rig.lenses), 6, 18)), np.empty((3, 12))
    for view in range(len(rig.lenses)):
        if not np.any(rig.covariances[view]):
            continue
        levers[view, :, :6] = fit.by_camera[view]
        for k in range(len(outlines.view_of)):
            if outlines.view_of[k] == view:
                _outline_by_lens(outlines, fit, k, rig.lenses[view], by_intrinsics)
                levers[view, :, 6:] -= fit.by_effect[k] @ by_intrinsics
    return levers


@compiled
def _center_in_camera(outlines: PackedOutlines, fit: OutlineFit, k: int) -> Floats:
    """Where ball-view k's ball is (3,) in its camera's frame, mm."""
    view = outlines.view_of[k]
    place = apply_matrix(fit.rotation, outlines.centers_body[k]) + fit.translation
    return apply_matrix(outlines.rotations[view], place) + outlines.translations[view]


@compiled
def pose_by_radius(
    outlines: PackedOutlines, fit: OutlineFit, ball_of: Ints, balls: int, lenses: Floats
) -> Floats:
    """Derivatives (6, b) of the pose by the balls' radii, per mm.

    A ball that is larger has larger outlines in all views. See docs/explanation/joint_fit.md,
    formula 22.
    """
    out = np.zeros((6, balls))
    for k in range(len(outlines.view_of)):
        out[:, ball_of[k]] += fit.by_effect[k, :, 2] * _px_per_mm(outlines, fit, k, lenses)
    return out


@compiled
def shape_covariance(
    outlines: PackedOutlines, fit: OutlineFit, variances: Floats, lenses: Floats
) -> Floats:
    """What balls that are out of round add to the pose's covariance (6, 6).

    Each view shows another outline of a ball, which shifts and grows independently: as random
    effects do, whose covariance the fit states. What is missing there is added. See
    docs/explanation/joint_fit.md, formula 23.

    Args:
        variances: (3,) of an outline's x, y and radius, mm^2.
    """
    out, stated = np.zeros((6, 6)), fit.effect_sd_px[np.array([0, 0, 1])] ** 2
    for k in range(len(outlines.view_of)):
        shape = variances * _px_per_mm(outlines, fit, k, lenses) ** 2
        out += (fit.by_effect[k] * np.maximum(shape - stated, 0.0)) @ fit.by_effect[k].T
    return out


@compiled
def _px_per_mm(outlines: PackedOutlines, fit: OutlineFit, k: int, lenses: Floats) -> float:
    """How far ball-view k's outline moves in its picture if the ball's surface does."""
    view, center = outlines.view_of[k], _center_in_camera(outlines, fit, k)
    square = np.sum(center * center) - outlines.radii[k] ** 2
    return float((lenses[view, 0] + lenses[view, 3]) / 2 / np.sqrt(square))


@compiled
def _outline_by_lens(
    outlines: PackedOutlines, fit: OutlineFit, k: int, lens: Floats, by_intrinsics: Floats
) -> None:
    """Fill the derivatives (3, 12) of ball-view k's outline (x, y, radius) by the intrinsics."""
    radius, center = outlines.radii[k], _center_in_camera(outlines, fit, k)
    moved, middle = _pixel_by_lens(center, lens)
    by_intrinsics[:2], by_intrinsics[2] = moved, 0.0
    for axis in range(2):
        for side in (-1.0, 1.0):
            edge = center.copy()
            edge[axis] += side * radius
            edge_moved, at = _pixel_by_lens(edge, lens)
            outward = (at - middle) / np.sqrt(np.sum((at - middle) ** 2))
            for j in range(12):
                growth = edge_moved[:, j] - moved[:, j]
                by_intrinsics[2, j] += (outward[0] * growth[0] + outward[1] * growth[1]) / 4


@compiled
def _pixel_by_lens(point: Floats, lens: Floats) -> tuple[Floats, Floats]:
    """Derivatives (2, 12) of a camera-frame point's pixel by the intrinsics, and the pixel (2,)."""
    moved, pixel = np.zeros((2, 12)), np.empty(2)
    by_lens(point[0] / point[2], point[1] / point[2], lens, moved)
    pixel[0], pixel[1] = to_pixel(point[0], point[1], point[2], lens)
    return moved, pixel


@compiled
def light_covariance(
    outlines: PackedOutlines, fit: OutlineFit, ball_of: Ints, balls: int, lenses: Floats
) -> Floats:
    """What shifts of a ball that all cameras share add to the pose's covariance (6, 6).

    Light falls on a ball from the same side for all cameras and shifts its outlines: the part of
    the shift that they share moves the ball and leaves no residual. Its standard deviation is taken
    as that of the part that does leave one, the random effects, and at least
    `_MIN_COMMON_SHIFT_PX`. Partly it is independent from ball to ball, and partly the same for all
    balls, as an error of the tone curve is for balls under the same light. See
    docs/explanation/joint_fit.md, formula 18.
    """
    levers, mm_per_px = np.zeros((balls, 6, 3)), 0.0
    for k in range(len(outlines.view_of)):
        view, center = outlines.view_of[k], _center_in_camera(outlines, fit, k)
        levers[ball_of[k]] += fit.by_ball[k]
        focal = (lenses[view, 0] + lenses[view, 3]) / 2
        mm_per_px += np.sqrt(np.sum(center * center)) / focal / len(outlines.view_of)
    out, together = np.zeros((6, 6)), np.zeros((6, 3))
    for ball in range(balls):
        out += levers[ball] @ levers[ball].T
        together += levers[ball]
    out += together @ together.T
    common_px = max(fit.effect_sd_px[0], _MIN_COMMON_SHIFT_PX)
    return out * (_PER_BALL_SHARE * (common_px * mm_per_px) ** 2)
