"""The pose of one body relative to another, with the errors that both share taken out.

A camera that stands elsewhere than its calibration says displaces both poses alike; what moves the
two as one rigid thing does not move one relative to the other. And what the balls of both say about
the cameras serves both: see `shared_cameras`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform, propagate, skew
from measure.measuring.measurement import Measurement, Status
from measure.measuring.shared_cameras import solved_together
from measure.model import Body, Camera, Pose


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
    reason = "; ".join(
        f"{of.name} {each.status.value}" + (f": {each.reason}" if each.reason else "")
        for of, each in (measured, reference)
        if each.pose is None or each.reason
    )
    if one.pose is None or other.pose is None:
        status = Status.SKIPPED if Status.SKIPPED in (one.status, other.status) else Status.LOST
        return replace(bare, pose=None, status=status, reason=reason)
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
        f"{of.name}: {flag}"
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
    return replace(bare, pose=pose, status=Status.FLAGGED if flags else Status.OK, reason=reason)


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
