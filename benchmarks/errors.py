"""Errors of poses against the truth, as the benchmarks count them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import SessionError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform, align_points, chi_square_quantile
from measure.measuring import Measurement
from measure.model import Body, Camera, Pose, Rig
from measure.session import Trajectory, read_trajectory, session_truth


def truth_of(session: Path) -> Trajectory:
    """The true trajectory of a session's body.

    Raises:
        SessionError: the session has none.
    """
    file = session_truth(session)
    if file is None:
        raise SessionError(f"{session}: the session has no truth: take one that has")
    return read_trajectory(file)


def pose_error(measured: Measurement, truth: Trajectory) -> Floats:
    """Difference (6,) of a pose from the truth in mm and rad; NaN without a pose."""
    if measured.pose is None:
        return np.full(6, np.nan)
    true = truth.at(np.array([measured.pose.time_s]))[0]
    return measured.pose.world_from_body.difference(true)


def in_region(error: Floats, pose: Pose, count: int) -> bool:
    """Whether the first `count` components of an error lie in the pose's 95 % region."""
    off, covariance = error[:count], pose.covariance[:count, :count]
    return bool(off @ np.linalg.solve(covariance, off) < chi_square_quantile(0.95, count))


def rms(rows: Floats) -> float:
    """Root mean squared length of rows (n, k); NaN if there are none."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1)))) if len(rows) else float("nan")


def aligned_rms(places: Floats, off: Floats) -> float:
    """What is left of errors (n, 3) at places (n, 3) after the rigid motion that fits best."""
    return rms(align_points(places, places + off).apply(places + off) - places)


def body_cost(
    estimated: tuple[Camera, ...], true: tuple[Camera, ...], body: Body, poses: list[RigidTransform]
) -> Floats:
    """What wrong cameras cost: true ball centres through true cameras, located with estimated ones.

    Args:
        estimated: cameras to judge.
        true: the same cameras as they are, in the same order.
        body: the body.
        poses: its true poses.

    Returns:
        Position errors (n, 3) of the body in mm.
    """
    count = len(body.balls)
    rig = Rig.of([camera for camera in estimated for _ in range(count)])
    rows = len(estimated) * count
    shifts = []
    for pose in poses:
        seen = PoseObservations(
            rig,
            np.tile(body.centers, (len(estimated), 1)),
            np.tile(np.arange(count), len(estimated)),
            np.concatenate([camera.project(pose.apply(body.centers)) for camera in true]),
            np.tile(np.eye(2), (rows, 1, 1)),
            np.zeros(rows),
        )
        found = fit_pose(pose, seen, tukey=np.inf, tolerance=1e-10).world_from_body
        shifts.append(found.difference(pose)[:3])
    return np.stack(shifts)
