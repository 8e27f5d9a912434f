"""Tracking's loops compiled, or loaded from disk, before the first pictures arrive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.estimation.body_layout import distances_from_body, layout_flags
from measure.geometry import RigidTransform
from measure.measuring.tracking.predictive.gating import Sighted, judge_sightings
from measure.measuring.tracking.predictive.motion_filter import MotionState
from measure.measuring.tracking.predictive.search_windows import predict_windows
from measure.model import Body, Camera, Pose


def warm_up(body: Body, cameras: Sequence[Camera]) -> None:
    """Follow a body that stays where it is, seen where it is expected."""
    still, one = RigidTransform.identity(), np.ones(6)
    state = MotionState.begin(still, np.eye(6), 0.0, one)
    times_s = {camera.name: 0.0 for camera in cameras}
    windows = predict_windows(state, times_s, state.possible(one), body, cameras)
    windows.expectations(1.0, 1.0, 0.1)
    balls, n = windows.balls, len(windows.keys)
    noise, now = np.tile(np.eye(2), (n, 1, 1)), np.zeros(n)
    seen = Sighted(balls.centers_px, noise, now, np.ones(n, np.bool_))
    judge_sightings(seen, np.arange(n), balls, state.covariance, 0.0, one, 0.5, 1.0)
    state.updated(Pose(0.0, still, np.eye(6), 0.0, 0.0, (), ()), one, one)
    places = np.tile(np.eye(3), (len(body.balls), 1, 1))
    layout_flags(body, body.names, body.centers, places, 1.0)
    distances_from_body(still.rotation, still.translation, body.centers, body.centers, places)
