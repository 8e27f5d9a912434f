"""The joint fit of one pose to every outline point of every ball in every camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Body, Camera, Detection
from measure_plugins._edges.contour_terms import bearings_of, eliminate, point_rows
from measure_plugins._edges.lens import lens_row

_STEPS = 15
_STEP_TOLERANCE = np.array([5e-4] * 3 + [1e-5] * 3)
"""mm and rad: a hundredth of what the best pictures allow."""
_SETTLED = np.array([2e-2] * 3 + [3e-4] * 3)
"""Steps (mm, rad) below which a fit that ran out of turns still counts as settled."""
_TUKEY = 4.685
_OFFSET_SD_PX = 3.0
"""A view's common edge offset is all but free; this only keeps a lone arc solvable."""
_SCATTER_START_PX = np.array([0.3, 0.3, 0.3])
_SCATTER_PRIOR_PX = 0.03
_SCATTER_PRIOR_COUNT = 1.0
_SCATTER_FLOOR_PX = 0.003
_RADIUS_SCATTER_FLOOR_PX = 0.1
"""Balls are not round to better than this, and their edges differ: sizes never tell range finer."""


@dataclass(frozen=True, eq=False)
class BallOutline:
    """One ball's outline in one camera, ready for the fit.

    Attributes:
        camera: the camera.
        view: index of the camera among those used.
        ball: index of the ball in the body.
        bearings: (n, 3) unit bearings of its points.
        sd_px: (n,).
        lens: (13,) lens row.
        motion: (6,) how far the body has moved, at this picture's time, from where it is at the
            pose's time (mm, rad, world).
    """

    camera: Camera
    view: int
    ball: int
    bearings: Floats
    sd_px: Floats
    lens: Floats
    motion: Floats


@dataclass(frozen=True, eq=False)
class ContourFit:
    """What the joint fit found.

    Attributes:
        world_from_body: the pose.
        information: (6, 6) inverse covariance, without the cameras' own uncertainty.
        offsets_px: (c,) outward edge offset of every view.
        shifts_px: (m, 3) of each ball-view: x, y and radius by which its outline sits off.
        shift_sd_px: (2,) estimated scatter of those: centre (per axis) and radius.
        shift_variances: (m, 3) of each ball-view, wider for those that fit badly, px^2.
        degrees: how many degrees of freedom that estimate rests on.
        residuals_px: per ball-view, residuals (n,) of its points after offsets and shifts.
        weights: per ball-view, robust weights (n,).
        converged: whether the steps died out.
    """

    world_from_body: RigidTransform
    information: Floats
    offsets_px: Floats
    shifts_px: Floats
    shift_sd_px: Floats
    shift_variances: Floats
    degrees: float
    residuals_px: list[Floats]
    weights: list[Floats]
    converged: bool


@dataclass(frozen=True, eq=False)
class _State:
    pose: RigidTransform
    offsets: Floats
    shifts: Floats
    scatter: Floats
    doubt: Floats
    information: Floats
    residuals: list[Floats]
    weights: list[Floats]
    step: Floats


def outlines_of(
    detections: Sequence[Detection],
    cameras: Mapping[str, Camera],
    body: Body,
    time_s: float,
    velocity: Floats,
) -> list[BallOutline]:
    """Bearings of all outline points; detections without an outline are left out."""
    seen = [d for d in detections if d.outline_px is not None and d.outline_sd_px is not None]
    names = sorted({d.camera for d in seen})
    out = []
    for d in seen:
        camera = cameras[d.camera]
        lens = lens_row(camera.intrinsics)
        assert d.outline_px is not None
        assert d.outline_sd_px is not None
        points = np.ascontiguousarray(d.outline_px)
        bearings = bearings_of(points, lens[None], np.zeros(len(points), np.int64))
        good = np.isfinite(bearings[:, 0])
        if np.count_nonzero(good) < 3:
            continue
        out.append(
            BallOutline(
                camera,
                names.index(d.camera),
                body.index(d.ball),
                bearings[good],
                d.outline_sd_px[good],
                lens,
                velocity * (d.time_s - time_s),
            )
        )
    return out


def fit_contours(
    outlines: Sequence[BallOutline],
    body: Body,
    start: RigidTransform,
    prior_information: Floats | None = None,
) -> ContourFit | None:
    """Fit the pose; Gauss-Newton with Tukey weights on points and random shifts of ball-views.

    Args:
        outlines: all ball-views.
        body: the body.
        start: pose to start from, right to a few mm and degrees.
        prior_information: (6, 6) added about `start`, for what the outlines leave open.

    Returns:
        The fit, or None where the outlines leave the pose open.
    """
    views = 1 + max(outline.view for outline in outlines)
    state = _State(
        start,
        np.zeros(views),
        np.zeros((len(outlines), 3)),
        _SCATTER_START_PX**2,
        np.ones(len(outlines)),
        np.zeros((6, 6)),
        [],
        [],
        np.full(6, np.inf),
    )
    for _ in range(_STEPS):
        following = _advance(state, outlines, body, start, prior_information)
        if following is None:
            return None
        state = following
        if np.all(np.abs(state.step) < _STEP_TOLERANCE):
            break
    return ContourFit(
        world_from_body=state.pose,
        information=state.information,
        offsets_px=state.offsets,
        shifts_px=state.shifts,
        shift_sd_px=np.sqrt(state.scatter[1:]),
        shift_variances=state.doubt[:, None] * state.scatter,
        degrees=max(2.0 * len(outlines) - 6.0, 1.0),
        residuals_px=state.residuals,
        weights=state.weights,
        converged=bool(np.all(np.abs(state.step) < _SETTLED)),
    )


def pose_rows(outline: BallOutline, body: Body, pose: RigidTransform) -> tuple[Floats, ...]:
    """Residuals (n,), derivatives of the outline by the pose (n, 6), and normals (n, 2)."""
    arm = pose.rotate(body.centers[outline.ball])
    center_world = pose.translation + arm
    center_world = center_world + outline.motion[:3] + np.cross(outline.motion[3:], arm)
    camera = outline.camera
    center = camera.camera_from_world.apply(center_world)
    residuals, by_center, normals = point_rows(
        center, body.balls[outline.ball].radius_mm, outline.bearings, outline.lens
    )
    by_world = by_center @ camera.camera_from_world.rotation
    return residuals, np.hstack([by_world, np.cross(arm, by_world)]), normals


def _advance(
    state: _State,
    outlines: Sequence[BallOutline],
    body: Body,
    start: RigidTransform,
    prior_information: Floats | None,
) -> _State | None:
    """One Gauss-Newton step, new weights and new scatter of the ball-views."""
    count = 6 + len(state.offsets)
    normal, right = np.zeros((count, count)), np.zeros(count)
    normal[6:, 6:] = np.eye(count - 6) / _OFFSET_SD_PX**2
    right[6:] = -state.offsets / _OFFSET_SD_PX**2
    if prior_information is not None:
        normal[:6, :6] += prior_information
        right[:6] -= prior_information @ state.pose.difference(start)
    recover, residuals, weights = [], [], []
    for k, outline in enumerate(outlines):
        raw, by_pose, normals = pose_rows(outline, body, state.pose)
        rows = np.zeros((len(raw), count))
        rows[:, :6], rows[:, 6 + outline.view] = by_pose, 1.0
        own = np.concatenate([normals, np.ones((len(raw), 1))], axis=1)
        error = raw - state.offsets[outline.view]
        left = error - own @ state.shifts[k]
        robust, weight = _point_weights(left, outline.sd_px)
        terms = eliminate(error, rows, own, weight, state.scatter * state.doubt[k])
        normal += terms[0]
        right += terms[1]
        recover.append((terms[2], terms[3], own, weight))
        residuals.append(left)
        weights.append(robust)
    if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)))) > 1e12:
        return None
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    step = covariance @ right
    shifts = np.stack([offset - gain @ step for offset, gain, _, _ in recover])
    scatter, doubt = _scatter(state, shifts, recover, covariance)
    return replace(
        state,
        pose=state.pose.perturb(step[:6]),
        offsets=state.offsets + step[6:],
        shifts=shifts,
        scatter=scatter,
        doubt=doubt,
        information=np.asarray(np.linalg.inv(covariance[:6, :6]), dtype=np.float64),
        residuals=residuals,
        weights=weights,
        step=step[:6],
    )


def _point_weights(residuals: Floats, sd: Floats) -> tuple[Floats, Floats]:
    """Robust weights (n,) and weights (n,) in px^-2 of one ball-view's points (Tukey)."""
    standard = residuals / sd
    scale = max(1.4826 * float(np.median(np.abs(standard))), 0.3)
    t = standard / (_TUKEY * scale)
    robust = np.where(np.abs(t) < 1, (1 - t * t) ** 2, 1e-6)
    return robust, robust / (sd * scale) ** 2


def _scatter(
    state: _State, shifts: Floats, recover: Sequence[tuple[Floats, ...]], covariance: Floats
) -> tuple[Floats, Floats]:
    """Variances (3,) of the ball-views' shifts by restricted maximum likelihood, and doubts (m,).

    The fixed point v = sum(b^2) / sum(1 - posterior variance / v) is MacKay's (1992) for random
    effects; the posterior variances hold the uncertainty of the shared unknowns, which makes it the
    restricted likelihood's (Laird and Ware 1982).
    """
    known = np.empty_like(shifts)
    for k, (_, gain, own, weight) in enumerate(recover):
        variance = state.scatter * state.doubt[k]
        inner = own.T @ (own * weight[:, None]) + np.diag(1 / variance)
        spread = np.linalg.inv(inner) + gain @ covariance @ gain.T
        known[k] = np.clip(1 - np.diag(spread) / variance, 0.02, 1.0)
    squares = shifts**2 / state.doubt[:, None]
    count, prior = _SCATTER_PRIOR_COUNT, _SCATTER_PRIOR_COUNT * _SCATTER_PRIOR_PX**2
    center = (prior + squares[:, :2].sum()) / (count + known[:, :2].sum())
    radius = (prior + squares[:, 2].sum()) / (count + known[:, 2].sum())
    floor = np.array([_SCATTER_FLOOR_PX, _SCATTER_FLOOR_PX, _RADIUS_SCATTER_FLOOR_PX]) ** 2
    scatter = np.maximum([center, center, radius], floor)
    typical = max(float(np.median(np.sum(shifts[:, :2] ** 2, axis=1))) / 1.386, 0.05**2)
    excess = np.sum(shifts[:, :2] ** 2, axis=1) / (9.0 * typical)
    return scatter, np.maximum(1.0, excess)


def camera_sensitivity(
    fit: ContourFit, outlines: Sequence[BallOutline], body: Body, camera: Camera
) -> Floats:
    """How the fitted pose (6,) reacts to a camera's pose (6, 6), both in their `perturb` charts.

    Moving the camera by (dt, w) moves every ball, as the camera sees it, by -dt - w x (X - t).
    """
    count = 6 + len(fit.offsets_px)
    total = np.zeros((count, count))
    right = np.zeros((count, 6))
    total[6:, 6:] = np.eye(count - 6) / _OFFSET_SD_PX**2
    for k, outline in enumerate(outlines):
        raw, by_pose, normals = pose_rows(outline, body, fit.world_from_body)
        rows = np.zeros((len(raw), count))
        rows[:, :6], rows[:, 6 + outline.view] = by_pose, 1.0
        own = np.concatenate([normals, np.ones((len(raw), 1))], axis=1)
        _, weight = _point_weights(fit.residuals_px[k], outline.sd_px)
        total += eliminate(raw, rows, own, weight, fit.shift_variances[k])[0]
        if outline.camera is not camera:
            continue
        arm = fit.world_from_body.apply(body.centers[outline.ball]) - camera.center
        by_camera = np.hstack([by_pose[:, :3], np.cross(arm, by_pose[:, :3])])
        for j in range(6):
            right[:, j] += eliminate(
                np.ascontiguousarray(by_camera[:, j]), rows, own, weight, fit.shift_variances[k]
            )[1]
    return np.asarray(np.linalg.solve(total, right)[:6])
