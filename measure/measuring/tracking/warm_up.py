"""Tracking's loops compiled, or loaded from disk, before the first pictures arrive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.geometry import RigidTransform
from measure.measuring.tracking.gates import agree_with_each_other, agree_with_prediction
from measure.measuring.tracking.motion_filter import MotionState
from measure.measuring.tracking.windows import predict_windows
from measure.model import Body, Camera, Pose


def warm_up(body: Body, cameras: Sequence[Camera]) -> None:
    """Follow a body that stays where it is, seen where it is expected."""
    still, one = RigidTransform.identity(), np.ones(6)
    state = MotionState.begin(still, np.eye(6), 0.0, one)
    balls = predict_windows(state, {c.name: 0.0 for c in cameras}, one, body, cameras).balls
    noise, off = np.tile(np.eye(2), (len(balls.radii_px), 1, 1)), np.zeros_like(balls.centers_px)
    agree_with_prediction(off, balls.covariances_px, noise, 1.0)
    agree_with_each_other(off, balls.jacobians, noise, state.covariance, 1.0, balls.radii_px)
    state.updated(Pose(0.0, still, np.eye(6), 0.0, 0.0, (), ()), one, one)
