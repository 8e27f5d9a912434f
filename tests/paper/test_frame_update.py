"""The frame-update algorithm as a state machine, fed with synthetic detections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model.observations import Reason
from measure_paper.simplex import SimplexSettings, SimplexSolver
from measure_paper.tracking import FrameUpdate
from tests.paper.frame_update_rig import (
    CAMERAS,
    STEP_S,
    Run,
    at_rest,
    drop,
    just_enough_color,
    only,
    shifted,
    smooth,
    wrong_color,
)
from tests.scenes import FOUR, RAVEN, moved, of_ball, ring, see


def test_it_is_found_by_its_name():
    assert Registry.discover().find("tracker", "frame-update").plugin is FrameUpdate


def test_smooth_motion_keeps_every_circle_effective():
    run = Run()
    for _ in range(40):
        run.step()
        assert run.suspended == {}
        assert run.conclusion.pose is not None
    error = run.conclusion.pose.world_from_body.difference(smooth(39 * STEP_S))
    assert np.abs(error).max() < 1e-4


def test_the_first_frame_is_searched_the_next_in_windows():
    run = Run().step()
    assert all(len(windows) == 0 for windows in run.expected.values())
    run.step()
    assert all(len(windows) == 3 for windows in run.expected.values())


def test_windows_come_from_the_earlier_circles():
    run = Run(motion=at_rest).steps(3)
    seen = {(d.ball, d.camera): d for d in see(CAMERAS, RAVEN, smooth(0.0), 0.5)}
    for camera, windows in run.expected.items():
        for window in windows:
            circle = seen[window.ball, camera]
            np.testing.assert_allclose(window.center_px, circle.center_px)
            low, high = window.radius_px
            assert low == pytest.approx(0.9 * circle.radius_px)
            assert high == pytest.approx(1.1 * circle.radius_px)
            assert window.min_distance_px == pytest.approx(circle.radius_px)
            assert window.reach_px == pytest.approx(
                4.0 + 100 * STEP_S * circle.radius_px / 20.0, rel=1e-6
            )


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


def test_enough_color_is_enough():
    run = Run().steps(5).step(spoil=only("red", "cam2", just_enough_color))
    assert run.suspended == {}


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


def test_recovery_needs_3d_consistency():
    run = Run().steps(3).step(spoil=only("green", "cam0", drop))
    run.steps(20, spoil=only("green", "cam0", shifted(12.0, 9.0)))
    assert run.suspended == {("green", "cam0"): Reason.INCONSISTENT}
    run.steps(5)
    assert run.suspended == {("green", "cam0"): Reason.RECOVERING}
    assert run.step().suspended == {}


def test_a_circle_of_the_wrong_size_is_not_consistent():
    run = Run().steps(3).step(spoil=only("green", "cam0", drop))
    run.steps(8, spoil=only("green", "cam0", lambda d: replace(d, radius_px=1.15 * d.radius_px)))
    assert run.suspended == {("green", "cam0"): Reason.INCONSISTENT}


def test_a_suspended_circle_is_looked_for_where_the_body_says():
    run = Run(motion=at_rest).steps(3)
    run.step(spoil=only("red", "cam3", shifted(80.0, 0.0))).step()
    window = next(w for w in run.expected["cam3"] if w.ball == "red")
    truth = of_ball(see(CAMERAS, RAVEN, smooth(0.0), 0.5), "red")[3]
    np.testing.assert_allclose(window.center_px, truth.center_px, atol=0.1)
    assert window.radius_px[0] < truth.radius_px < window.radius_px[1]


def test_a_missing_image_is_no_objection_to_the_circle():
    run = Run().steps(3).step(without=("cam1",))
    assert set(run.suspended.values()) == {Reason.NO_IMAGE}
    assert {camera for _, camera in run.suspended} == {"cam1"}
    assert run.step().suspended == {}


def test_too_few_circles_skip_a_few_frames_and_restart():
    run = Run(skip_frames=3).steps(4)
    run.step(spoil=lambda d: None if d.ball == "red" and d.camera != "cam0" else d)
    assert run.conclusion.pose is None
    assert "red 1" in run.conclusion.reason
    for _ in range(3):
        assert run.step().expected is None
    run.step()
    assert run.expected is not None
    assert run.suspended == {}
    assert run.conclusion.pose is not None


def test_two_effective_circles_are_enough():
    run = Run().steps(3)
    run.step(spoil=lambda d: None if d.ball == "red" and d.camera in ("cam0", "cam3") else d)
    assert len(run.suspended) == 2
    assert run.conclusion.pose is not None


def test_tolerance_rises_with_every_failure_and_converges_back():
    run = Run(skip_frames=1, tolerance_step=1.5, tolerance_max=3.0, tolerance_decay=0.5).steps(3)
    assert run.tracker.tolerance == 1.0
    risen = []
    for _ in range(4):
        run.step(spoil=drop)
        risen.append(run.tracker.tolerance)
        run.step()
    assert risen == [1.5, 2.25, 3.0, 3.0]
    falling = [run.step().tracker.tolerance for _ in range(12)]
    assert falling[:3] == [2.0, 1.5, 1.25]
    assert falling[-1] == pytest.approx(1.0, abs=1e-3)


def test_raised_tolerance_widens_every_range():
    still = {"motion": at_rest, "skip_frames": 0}
    normal, raised = Run(**still).steps(4), Run(**still).steps(3).step(spoil=drop)
    normal.step(), raised.step()
    assert raised.tracker.tolerance < 1.5
    for camera in CAMERAS:
        for usual, wide in zip(normal.expected[camera], raised.expected[camera], strict=True):
            assert wide.tolerance == 1.5
            assert wide.reach_px > 1.4 * usual.reach_px
            assert wide.radius_px[0] < usual.radius_px[0]
            assert wide.radius_px[1] > usual.radius_px[1]
            assert wide.min_distance_px == pytest.approx(usual.min_distance_px / 1.5, rel=0.02)


def test_after_repeated_failures_whole_frames_are_searched():
    run = Run(skip_frames=0).steps(3)
    run.step(spoil=drop).step(spoil=drop).step()
    assert all(len(windows) == 0 for windows in run.expected.values())
    assert run.conclusion.pose is not None


def test_a_restart_elsewhere_is_found():
    """The body is carried away while nobody sees it."""
    run = Run(motion=lambda t: smooth(0.0) if t < 5 * STEP_S else smooth(1.0), skip_frames=1)
    run.steps(5).steps(6, spoil=drop).steps(2)
    assert run.conclusion.pose is not None
    error = run.conclusion.pose.world_from_body.difference(smooth(1.0))
    assert np.abs(error).max() < 1e-4


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
    assert run.conclusion.pose is not None
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


def test_nothing_seen_at_all_gives_no_pose():
    run = Run()
    for _ in range(12):
        run.step(spoil=drop)
        assert run.conclusion is None or run.conclusion.pose is None
        assert all(view.reason is Reason.NOT_FOUND for view in run.views)


def test_four_balls_go_on_when_one_is_lost_everywhere():
    cameras = ring(5)
    run = Run(body=FOUR, cameras=cameras).steps(3)
    run.steps(4, spoil=lambda d: None if d.ball == "blue" else d)
    assert run.conclusion.pose is not None
    assert run.conclusion.pose.balls == ("white", "orange", "green")
    run.steps(5)
    assert {ball for ball, _ in run.suspended} == {"blue"}
    assert run.step().suspended == {}


def test_two_cameras_are_enough():
    cameras = dict(list(CAMERAS.items())[:2])
    run = Run(cameras=cameras).steps(20)
    assert run.suspended == {}
    error = run.conclusion.pose.world_from_body.difference(smooth(19 * STEP_S))
    assert np.abs(error).max() < 1e-4


def test_a_moved_camera_is_flagged_and_named():
    """Half a degree: 4 mm at the balls, within the tolerance of consistency with three others."""
    run = Run(consistency_mm=4.0)
    camera = CAMERAS["cam2"]
    turn = RigidTransform.from_rotvec([0.0, np.radians(0.5), 0.0])
    wrong = moved(camera, camera.world_from_camera @ turn)
    run.real_cameras = {**CAMERAS, "cam2": wrong}
    run.step()
    assert run.conclusion.pose is not None
    assert "rays miss the balls" in run.conclusion.pose.flags[0]
    assert "cam2" in run.conclusion.pose.flags[0]
