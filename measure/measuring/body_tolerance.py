"""What the body's own tolerance leaves open of its pose: no picture shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform, skew
from measure.measuring.measurement import Measurement
from measure.model import Body

_NOTHING = 1e-9
"""Share of the largest eigenvalue that a direction which the balls used leave open may have."""


def tolerance_covariance(
    body: Body, world_from_body: RigidTransform, balls: Sequence[str]
) -> Floats:
    """Covariance (6, 6), in the pose's `perturb` chart, of what misplaced balls do to a pose.

    Balls that sit d_i from their places move the least-squares pose by (sum J_i^T J_i)^-1
    sum J_i^T d_i with J_i = [1, -[R c_i]x]. Where all d_i are independent, and alike in all
    directions, that has the covariance tolerance^2 (sum J_i^T J_i)^-1. What too few balls leave
    open they do not move.

    Args:
        body: its balls and its tolerance.
        world_from_body: the pose.
        balls: names of those it was measured with.
    """
    turns = -skew(body.centers_of(balls) @ world_from_body.rotation.T)
    J = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2).reshape(-1, 6)
    share = np.linalg.pinv(J.T @ J, rcond=_NOTHING, hermitian=True)
    return np.asarray(body.tolerance_mm**2 * share, dtype=np.float64)


def tolerance_sd(body: Body, world_from_body: RigidTransform) -> tuple[float, float]:
    """The same, of all balls, as standard deviations of position (mm) and rotation (deg)."""
    variances = np.diag(tolerance_covariance(body, world_from_body, body.names))
    return float(np.sqrt(variances[:3].sum())), float(np.degrees(np.sqrt(variances[3:].sum())))


def with_tolerance(measured: Measurement, body: Body) -> Measurement:
    """A measurement whose pose states what the body's tolerance leaves open as well."""
    pose = measured.pose
    if pose is None or not body.tolerance_mm:
        return measured
    share = tolerance_covariance(body, pose.world_from_body, pose.balls)
    return replace(measured, pose=replace(pose, covariance=pose.covariance + share))
