"""The jointly fitted pose with its covariance: random effects, light, and calibration.

Everywhere k ball-views in c views show some of a body's b balls, ball-view i ball `ball_of[i]`; the
lens rows are (c, 16).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.model.rig import RigRows
from measure.model.rig_kernels import by_cameras, project_rows
from measure_plugins._joint_fit.elimination import prior_view_shifts
from measure_plugins._joint_fit.problem import PackedOutlines
from measure_plugins._joint_fit.solve import OutlineFit, Start, fit_outlines

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
