"""Several bodies in the same pictures: each is tracked by itself and confused with none.

The pose of one body relative to another has the errors that both share taken out. A camera that
stands elsewhere than its calibration says displaces both poses alike; what moves the two as one
rigid thing does not move one relative to the other.

Solved alone, each of two bodies trusts the cameras as its own balls ask for; together they see the
same cameras. Generalised least squares (Aitken 1936) of the centres of both, whose covariance holds
what an uncertain camera does to all of them, gives the step from the poses solved alone to those
solved together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, tee
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from measure.arrays import Floats
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, propagate, skew
from measure.measuring.measurement import Measurement, Status
from measure.measuring.pipeline import Pipeline
from measure.model import Body, Camera, Detection, Doubt, FrameSet, Pose


class TogetherStep(NamedTuple):
    """From two poses solved alone to the same solved together, in their `perturb` charts."""

    step: Floats  # (12,) of the one pose, then of the other
    alone: Floats  # (12, 12) covariance of the poses solved alone, by pixels and cameras
    together: Floats  # (12, 12) the same of those solved together


def solved_together(
    pairs: Sequence[tuple[Body, Measurement]], cameras: Sequence[Camera]
) -> TogetherStep | None:
    """How the poses of bodies change if they are solved together.

    None if no uncertain camera sees them, or if the centres seen of one do not tell its pose: two
    balls leave it a turn, which its solver has from elsewhere.

    Args:
        pairs: each body and its measurement of the same frame set, with a pose.
        cameras: all cameras, with their covariances.
    """
    uncertain = [camera for camera in cameras if camera.covariance is not None]
    seen = [_seen(measured, uncertain) for _, measured in pairs]
    if not all(map(_tell_pose, seen)):
        return None
    linear = [
        _linearised(body, measured.pose.world_from_body, views, uncertain)
        for (body, measured), views in zip(pairs, seen, strict=True)
        if measured.pose is not None
    ]
    by_pose, noise = (block_diag(*parts) for parts in zip(*[o[1:3] for o in linear], strict=True))
    known = block_diag(*[c.covariance for c in uncertain if c.covariance is not None])
    by_camera = np.vstack([one.by_camera for one in linear])
    shared = propagate(by_camera, known)
    apart = block_diag(*[propagate(one.by_camera, known) for one in linear])
    residuals = np.concatenate([one.residuals for one in linear])
    alone, together = (_estimator(by_pose, noise + part) for part in (apart, shared))
    return TogetherStep(
        (together - alone) @ residuals,
        propagate(alone, noise + shared),
        propagate(together, noise + shared),
    )


class _CenterEquations(NamedTuple):
    """The n coordinates in pictures of a body's balls."""

    residuals: Floats  # (n,) detected less predicted, px
    by_pose: Floats  # (n, 6)
    noise: Floats  # (n, n) px^2
    by_camera: Floats  # (n, 18 c)


_Seen = list[tuple[Detection, Floats]]
"""Detections of a body with what they are off the prediction (2,), px."""


def _seen(measured: Measurement, cameras: Sequence[Camera]) -> _Seen:
    """The effective detections in `cameras`."""
    names, off = {camera.name for camera in cameras}, measured.residuals_px
    used = [view.detection for view in measured.views if view.effective and view.detection]
    return [(d, off[d.ball, d.camera]) for d in used if d.camera in names]


def _tell_pose(seen: _Seen) -> bool:
    """Whether centres alone determine a pose, with some left to contradict each other."""
    return len({d.ball for d, _ in seen}) > 2 and len(seen) > 3


def _linearised(
    body: Body, place: RigidTransform, seen: _Seen, cameras: Sequence[Camera]
) -> _CenterEquations:
    from measure.model.projection import by_cameras

    by_name = {camera.name: camera for camera in cameras}
    rows = [list(by_name).index(d.camera) for d, _ in seen]
    centers = PoseObservations.of([d for d, _ in seen], body, by_name, time_s=0.0)
    _, by_pose, _ = centers.residuals(place, np.zeros(6))
    by_camera = np.zeros((len(seen), 2, len(cameras), 18))
    points = place.apply(centers.points_body)
    by_camera[np.arange(len(seen)), :, rows] = by_cameras(centers.rig.rows, points)
    return _CenterEquations(
        np.concatenate([off for _, off in seen]),
        by_pose.reshape(-1, 6),
        block_diag(*centers.noise),
        by_camera.reshape(2 * len(seen), -1),
    )


def _estimator(by_unknown: Floats, covariance: Floats) -> Floats:
    """What generalised least squares multiplies residuals (n,) with: (k, n)."""
    weighted = np.linalg.solve(covariance, by_unknown).T
    return np.linalg.solve(weighted @ by_unknown, weighted)


def relative_measurement(
    measured: tuple[Body, Measurement],
    reference: tuple[Body, Measurement],
    cameras: Sequence[Camera],
) -> Measurement:
    """A frame set's pose of a body in the frame of the reference; without one if either has none.

    With C the covariance of both poses (12, 12), whose cross terms are what the errors of the
    cameras' calibrations and of the world's scale do to both, and J the derivatives of
    reference_from_body by the two, the covariance is J C J^T in the reference's frame. Of a solver
    that does not state what a camera's error does to its pose (`Pose.by_camera`) the two count as
    independent but for the scale. Where cameras are uncertain, pose and covariance are then moved
    to those of both bodies solved together.

    Args:
        measured: the body, and what was measured of it.
        reference: the same of the reference, for the same frame set.
        cameras: all cameras.
    """
    (body, one), (base, other) = measured, reference
    bare = replace(one, views=(), positions=(), residuals_px={}, searched=())
    reasons = tuple(
        Doubt.of(text).of_body(of.name)
        for of, each in (measured, reference)
        for text in (*([] if each.pose else [Doubt("no-pose", status=each.status)]), *each.reasons)
    )
    if one.pose is None or other.pose is None:
        status = Status.SKIPPED if Status.SKIPPED in (one.status, other.status) else Status.LOST
        return replace(bare, pose=None, status=status, reasons=reasons)
    here, there = one.pose.world_from_body, other.pose.world_from_body
    by_poses = _by_poses(here, there)
    covariance = propagate(by_poses, _joint_covariance(one.pose, other.pose, cameras))
    if (shared := solved_together((measured, reference), cameras)) is not None:
        here, there = here.perturb(shared.step[:6]), there.perturb(shared.step[6:])
        alone, together = (
            np.asarray(np.linalg.cholesky(propagate(by_poses, each)))
            for each in (shared.alone, shared.together)
        )
        covariance = propagate(together @ np.linalg.inv(alone), covariance)
    flags = tuple(
        Doubt.of(flag).of_body(of.name)
        for of, pose in ((body, one.pose), (base, other.pose))
        for flag in pose.flags
    )
    pose = Pose(
        time_s=one.pose.time_s,
        world_from_body=there.inverse() @ here,
        covariance=covariance,
        residual_mm=float("nan"),
        rms_px=float(np.hypot(one.pose.rms_px, other.pose.rms_px) / np.sqrt(2)),
        cameras=tuple(dict.fromkeys((*one.pose.cameras, *other.pose.cameras))),
        balls=one.pose.balls,
        flags=flags,
    )
    return replace(bare, pose=pose, status=Status.FLAGGED if flags else Status.OK, reasons=reasons)


def relative_measurements(
    bodies: Sequence[Body],
    measured: Sequence[Measurement],
    reference: str,
    cameras: Sequence[Camera],
) -> dict[str, Measurement]:
    """The same of every body but the reference, by the body's name; none without a reference."""
    pairs = {body.name: (body, one) for body, one in zip(bodies, measured, strict=True)}
    base = pairs.pop(reference, None)
    if base is None:
        return {}
    return {name: relative_measurement(pair, base, cameras) for name, pair in pairs.items()}


def _by_poses(here: RigidTransform, there: RigidTransform) -> Floats:
    """Derivatives (6, 12) of the relative pose by that of the body, then of the reference."""
    into = there.rotation.T
    by_body = np.kron(np.eye(2), into)
    by_reference = -by_body.copy()
    by_reference[:3, 3:] = into @ skew(here.translation - there.translation)
    return np.hstack([by_body, by_reference])


def _joint_covariance(one: Pose, other: Pose, cameras: Sequence[Camera]) -> Floats:
    """Covariance (12, 12) of two poses, each in its `perturb` chart."""
    out = np.zeros((12, 12))
    out[:6, :6], out[6:, 6:] = one.covariance, other.covariance
    mine, its = one.by_camera or {}, other.by_camera or {}
    for camera in cameras:
        if camera.covariance is not None and camera.name in mine and camera.name in its:
            out[:6, 6:] += mine[camera.name] @ camera.covariance @ its[camera.name].T
    out[6:, :6] = out[:6, 6:].T
    return out


_OVERLAP = 0.8
"""Share of the radii's sum; two balls are never nearer than the sum, but poses have errors."""
_NEAR_MM = 30.0  # How far from a declared body's balls evidence of a second body is still that body


def measure_together(
    pipelines: Sequence[Pipeline], frame_sets: Iterable[FrameSet]
) -> Iterator[tuple[Measurement, ...]]:
    """Measure several bodies; yields a measurement of each for every frame set, in order.

    Args:
        pipelines: one for each body, of the same cameras.
        frame_sets: in order of time; read once, and kept until the last body is done with them.

    Raises:
        MeasureError: what the frame sets raise, after those before it have been measured.
    """
    for one in pipelines:
        one.others = tuple(other for other in pipelines if other is not one)
    bodies = [one.body for one in pipelines]
    *copies, last = tee(frame_sets, len(pipelines))
    measured = [
        one.measure(copy) for one, copy in zip(pipelines, [*copies, _releasing(last)], strict=True)
    ]
    explained = set[str]()
    for row in zip(*measured, strict=True):
        yield _reconciled(row, bodies, explained) if len(row) > 1 else row


def _releasing(frame_sets: Iterable[FrameSet]) -> Iterator[FrameSet]:
    """The same; pixels go once they are measured, so that their memory, still cached, is reused."""
    for frame_set in frame_sets:
        yield frame_set
        for image in frame_set.images.values():
            image.release()


def _reconciled(
    row: tuple[Measurement, ...], bodies: Sequence[Body], explained: set[str]
) -> tuple[Measurement, ...]:
    """The same, where bodies that are declared are no strangers, and do not share a place.

    Args:
        explained: flags of a second body that was a declared one; they hold on for a while, and
            are dropped then as well.
    """
    poses = [(body, one.pose) for body, one in zip(bodies, row, strict=True)]
    out = [_known(one, poses[:k] + poses[k + 1 :], explained) for k, one in enumerate(row)]
    for i, j in combinations(range(len(row)), 2):
        one, other = row[i].pose, row[j].pose
        if one is not None and other is not None and _overlap(bodies[i], one, bodies[j], other):
            out[i] = out[i].flagged(Doubt("overlap", other=bodies[j].name))
            out[j] = out[j].flagged(Doubt("overlap", other=bodies[i].name))
    return tuple(out)


def _known(
    measured: Measurement, others: Sequence[tuple[Body, Pose | None]], explained: set[str]
) -> Measurement:
    """The measurement without flags of a second body that is one of the others."""
    pose = measured.pose
    flags = () if pose is None else pose.flags
    raised = [one for one in map(Doubt.of, flags) if one.code == "second-body"]
    if pose is None or not raised:
        return measured
    for body, its in others:
        if its is not None:
            balls = its.world_from_body.apply(body.centers)
            middle = balls.mean(axis=0)
            reach = _NEAR_MM + np.max(np.linalg.norm(balls - middle, axis=1))
            for flag in raised:
                place = [flag.values[name] for name in ("x_mm", "y_mm", "z_mm")]
                explained |= {flag} if np.linalg.norm(place - middle) < reach else set()
    flags = tuple(flag for flag in pose.flags if flag not in explained)
    status = Status.FLAGGED if flags else Status.OK
    return replace(measured, pose=replace(pose, flags=flags), status=status)


def _overlap(body: Body, pose: Pose, other: Body, its: Pose) -> bool:
    apart = np.linalg.norm(
        pose.world_from_body.apply(body.centers)[:, None]
        - its.world_from_body.apply(other.centers),
        axis=2,
    )
    return bool(np.any(apart < _OVERLAP * (body.radii[:, None] + other.radii)))
