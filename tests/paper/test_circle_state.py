"""The paper's two states: every transition, with evidence made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from measure.model import Detection
from measure.model.observations import Reason, State
from measure_paper.tracking.circle_state import Circle, CircleEvidence, advance, remember

GOOD = CircleEvidence(found=True, consistent=True)
UNKNOWN = CircleEvidence(found=True)
LOST = CircleEvidence(found=False)
OFF_COLOR = CircleEvidence(found=True, color_ok=False, consistent=True)
JUMP = CircleEvidence(found=True, moved_too_far=True)
WRONG = CircleEvidence(found=True, consistent=False)
N = 5


def run(*evidence, circle=None):
    circle = circle or Circle()
    for one in evidence:
        circle = advance(circle, one, N)
    return circle


def test_every_circle_is_initialised_as_effective():
    assert Circle().effective
    assert Circle().reason is Reason.NONE


@pytest.mark.parametrize(
    ("evidence", "reason"),
    [
        (LOST, Reason.NOT_FOUND),
        (OFF_COLOR, Reason.COLOR),
        (JUMP, Reason.JUMPED),
        (WRONG, Reason.INCONSISTENT),
    ],
)
def test_each_cause_suspends(evidence, reason):
    circle = run(evidence)
    assert circle.state is State.SUSPENDED
    assert circle.reason is reason


@pytest.mark.parametrize("evidence", [GOOD, UNKNOWN])
def test_a_good_circle_stays_effective(evidence):
    assert run(*[evidence] * 20).effective


def test_recovery_takes_more_than_five_good_frames():
    suspended = run(LOST)
    after_five = run(*[GOOD] * 5, circle=suspended)
    assert after_five.state is State.SUSPENDED
    assert after_five.reason is Reason.RECOVERING
    assert after_five.good_frames == 5
    assert run(GOOD, circle=after_five).effective


@pytest.mark.parametrize("bad", [LOST, OFF_COLOR, WRONG, UNKNOWN])
def test_one_bad_frame_starts_the_count_again(bad):
    circle = run(LOST, *[GOOD] * 5, bad)
    assert circle.state is State.SUSPENDED
    assert circle.good_frames == 0
    assert not run(*[GOOD] * 5, circle=circle).effective
    assert run(*[GOOD] * 6, circle=circle).effective


def test_no_recovery_without_3d_consistency():
    assert not run(LOST, *[UNKNOWN] * 50).effective
    assert not run(LOST, *[WRONG] * 50).effective


def test_a_suspended_circle_is_not_asked_for_its_motion():
    jumped_but_consistent = CircleEvidence(found=True, moved_too_far=True, consistent=True)
    assert run(LOST, *[jumped_but_consistent] * 6).effective


@given(st.lists(st.sampled_from([GOOD, UNKNOWN, LOST, OFF_COLOR, JUMP, WRONG]), max_size=40))
def test_effective_needs_no_failed_check_or_six_good_frames(history):
    circle = run(*history)
    good = [one.found and one.color_ok and one.consistent is True for one in history]
    clean = [
        one.found and one.color_ok and not one.moved_too_far and one.consistent is not False
        for one in history
    ]
    if not circle.effective:
        assert not all(clean)
        assert circle.reason is not Reason.NONE
    elif not all(clean):
        last_bad = max(index for index, one in enumerate(clean) if not one)
        # Since its last suspension it has been good for six frames in a row.
        runs = "".join("g" if one else "-" for one in good)
        assert "g" * 6 in runs
        assert len(history) - last_bad > 0


def test_memory_follows_the_circle_and_smooths_the_radius():
    def seen(x, radius, time_s):
        return Detection("red", "cam0", time_s, np.array([x, 50.0]), radius, np.eye(2))

    circle = remember(remember(Circle(), seen(10.0, 60.0, 0.0)), seen(14.0, 70.0, 0.1))
    assert circle.center_px.tolist() == [14.0, 50.0]
    assert circle.radius_px == 65.0
    assert circle.time_s == 0.1
