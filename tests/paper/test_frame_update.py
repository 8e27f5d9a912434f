"""The frame-update algorithm as a state machine, fed with synthetic detections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.model.observations import Reason
from measure_paper.simplex import SimplexSettings, SimplexSolver
from tests.paper.frame_update_rig import (
    CAMERAS,
    STEP_S,
    Run,
    drop,
    only,
    shifted,
    smooth,
    wrong_color,
)
from tests.scenes import FOUR, RAVEN, moved, ring


def test_smooth_motion_keeps_every_circle_effective():
    run = Run()
    for _ in range(40):
        run.step()
        assert run.suspended == {}
    error = run.conclusion.pose.world_from_body.difference(smooth(39 * STEP_S))
    assert np.abs(error).max() < 1e-4


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (drop, Reason.NOT_FOUND),
        (wrong_color, Reason.COLOR),
        (shifted(60.0, 0.0), Reason.JUMPED),
        (shifted(0.0, -40.0), Reason.JUMPED),
    ],
)
def test_one_lying_camera_is_suspended_for_the_right_reason(change, reason):
    run = Run().steps(5)
    run.step(spoil=only("red", "cam2", change))
    assert run.suspended == {("red", "cam2"): reason}
    error = run.conclusion.pose.world_from_body.difference(smooth(5 * STEP_S))
    assert np.abs(error).max() < 1e-4


def test_a_slowly_drifting_false_circle_is_suspended():
    run = Run().steps(3)
    for frame in range(12):
        run.step(spoil=only("yellow", "cam1", shifted(2.0 * frame, 0.0)))
    assert run.suspended == {("yellow", "cam1"): Reason.INCONSISTENT}


def test_recovery_takes_more_than_five_good_frames():
    run = Run().steps(3).step(spoil=only("green", "cam0", drop))
    for _ in range(5):
        run.step()
        assert run.suspended == {("green", "cam0"): Reason.RECOVERING}
        assert not run.view("green", "cam0").effective
        assert run.view("green", "cam0").detection is not None
    run.step()
    assert run.suspended == {}


def test_too_few_circles_skip_a_few_frames_and_restart():
    run = Run(skip_frames=3).steps(4)
    run.step(spoil=lambda d: None if d.ball == "red" and d.camera != "cam0" else d)
    assert run.conclusion.pose is None
    assert run.conclusion.reason.plain == {"code": "few-circles", "balls": ("red",)}
    for _ in range(3):
        assert run.step().expected is None
    run.step()
    assert run.expected is not None
    assert run.suspended == {}
    assert run.conclusion.pose is not None


def test_the_start_is_not_taken_in_by_a_steady_false_circle():
    run = Run().step(spoil=only("yellow", "cam1", shifted(90.0, 40.0)))
    assert run.suspended == {("yellow", "cam1"): Reason.INCONSISTENT}
    error = run.conclusion.pose.world_from_body.difference(smooth(0.0))
    assert np.abs(error).max() < 1e-4


def test_a_body_of_the_wrong_shape_is_never_reported():
    """Two balls exchange their colours: every ray agrees, the distances do not."""
    other = replace(
        RAVEN, balls=(replace(RAVEN.balls[0], center_mm=np.array([58.0, 0, 0])), *RAVEN.balls[1:])
    )
    run = Run()
    run.body = other
    for _ in range(10):
        run.step()
        assert run.conclusion is None or run.conclusion.pose is None


def test_a_slightly_wrong_shape_is_flagged():
    other = replace(
        RAVEN, balls=(replace(RAVEN.balls[0], center_mm=np.array([42.5, 0, 0])), *RAVEN.balls[1:])
    )
    run = Run()
    run.body = other
    run.solver = SimplexSolver(SimplexSettings(), RAVEN)
    run.step()
    assert "body's shape" in run.conclusion.pose.flags[0]


def test_a_badly_fitting_pose_is_refused_then_a_restart():
    other = replace(
        RAVEN, balls=(replace(RAVEN.balls[0], center_mm=np.array([43.5, 0, 0])), *RAVEN.balls[1:])
    )
    run = Run(max_residual_mm=1.2)
    run.body = other
    run.step()
    assert run.conclusion.pose is None
    assert "pose refused" in run.conclusion.reason
    assert run.step().expected is None


def test_four_balls_go_on_when_one_is_lost_everywhere():
    cameras = ring(5)
    run = Run(body=FOUR, cameras=cameras).steps(3)
    run.steps(4, spoil=lambda d: None if d.ball == "blue" else d)
    assert run.conclusion.pose.balls == ("white", "orange", "green")
    run.steps(5)
    assert {ball for ball, _ in run.suspended} == {"blue"}
    assert run.step().suspended == {}


def test_a_moved_camera_is_flagged_and_named():
    """Half a degree: 4 mm at the balls, within the tolerance of consistency with three others."""
    run = Run(consistency_mm=4.0)
    camera = CAMERAS["cam2"]
    turn = RigidTransform.from_rotvec([0.0, np.radians(0.5), 0.0])
    wrong = moved(camera, camera.world_from_camera @ turn)
    run.real_cameras = {**CAMERAS, "cam2": wrong}
    run.step()
    assert "rays miss the balls" in run.conclusion.pose.flags[0]
    assert "cam2" in run.conclusion.pose.flags[0]
