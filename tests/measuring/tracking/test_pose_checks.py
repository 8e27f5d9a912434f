"""Reasons to doubt a pose, each with what is no reason."""

from __future__ import annotations

import numpy as np
import pytest

from measure.measuring.tracking.predictive.pose_checks import (
    unconfirmed_balls,
    unstable_initialisation,
)
from measure.model import BallView, Detection
from measure.model.observations import Reason, State
from tests.scenes import FOUR, RAVEN

_IN_STEP, _OUT_OF_STEP = [0.0] * 4, [0.0, 0.01, 0.02, 0.03]


def _view(ball: str, camera: str, reason: Reason, seen: bool = True) -> BallView:
    state = State.SUSPENDED if reason else State.EFFECTIVE
    found = Detection(ball, camera, 0.0, np.zeros(2), 30.0, np.eye(2)) if seen else None
    return BallView(ball, camera, state, reason, found)


@pytest.mark.parametrize(
    ("reasons", "times_s", "flagged"),
    [
        ([Reason.JUMPED, Reason.INCONSISTENT], _OUT_OF_STEP, True),
        ([Reason.JUMPED, Reason.INCONSISTENT], _IN_STEP, False),
        ([Reason.JUMPED], _OUT_OF_STEP, False),
        ([Reason.COLOR, Reason.COLOR], _OUT_OF_STEP, False),
    ],
)
def test_contradictions_after_a_search_are_flagged(reasons, times_s, flagged):
    right = [_view(ball, camera, Reason.NONE) for camera in ("a", "b") for ball in RAVEN.names]
    wrong = [_view(RAVEN.names[k], "c", reason) for k, reason in enumerate(reasons)]
    unseen = [_view(ball, "d", Reason.NOT_FOUND, seen=False) for ball in RAVEN.names]
    assert bool(unstable_initialisation([*right, *wrong, *unseen], times_s)) == flagged


def test_a_ball_is_flagged_until_two_cameras_saw_it():
    confirmed: set[str] = set()
    three = [_view(ball, camera, Reason.NONE) for camera in "ab" for ball in FOUR.names[:3]]
    (found,) = unconfirmed_balls(three, FOUR, confirmed)
    assert FOUR.names[3] in found
    last = [_view(FOUR.names[3], camera, Reason.NONE) for camera in "ab"]
    assert unconfirmed_balls(last[:1], FOUR, confirmed) == (found,)
    assert unconfirmed_balls(last, FOUR, confirmed) == ()
    assert unconfirmed_balls([], FOUR, confirmed) == ()
    assert unconfirmed_balls([], RAVEN, set()) == ()
