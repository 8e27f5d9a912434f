from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.measuring import Status
from measure.model import Body, Camera
from measure.model.observations import Reason, State
from tests.scenes import FOUR, RAVEN, TARGET, ring
from tests.tracking_rig import frame_sets, run

CAMERAS = ring()


def path(time_s):
    """A smooth motion at up to 60 mm/s and 0.5 rad/s."""
    shift = 25 * np.array([np.sin(2.4 * time_s), np.cos(1.7 * time_s), np.sin(1.1 * time_s)])
    rotvec = 0.3 * np.array([np.sin(1.5 * time_s), np.cos(1.2 * time_s), np.sin(0.7 * time_s)])
    return RigidTransform.from_rotvec(rotvec, TARGET + shift)


def one_body(body=RAVEN):
    return lambda time_s: [(body, path(time_s))]


def errors_mm(measured):
    return np.array(
        [
            np.linalg.norm(m.pose.world_from_body.translation - path(m.pose.time_s).translation)
            for m in measured
        ]
    )


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=lambda body: body.name)
def test_searches_once_then_tracks(body):
    measured, detectors, _ = run(body, one_body(body), CAMERAS, sharp=False)
    assert [m.status for m in measured] == [Status.OK] * 20
    assert all(d.searched == 1 for d in detectors.values())
    assert measured[0].searched == tuple(CAMERAS)
    assert measured[5].searched == ()
    assert np.max(errors_mm(measured[1:])) < 0.1
    assert all(v.state is State.EFFECTIVE for v in measured[-1].views)


def test_unsynchronised_cameras_are_brought_to_one_instant():
    phases = [0.0, 0.011, 0.024, 0.006]
    live, _, _ = run(RAVEN, one_body(), CAMERAS, 40, phases=phases)
    offline, _, _ = run(RAVEN, one_body(), CAMERAS, 40, phases=phases, smoothing=True)
    assert np.sqrt(np.mean(errors_mm(live[5:]) ** 2)) < 0.06
    assert np.sqrt(np.mean(errors_mm(offline[5:]) ** 2)) < 0.04
    ignored, _, _ = run(RAVEN, one_body(), CAMERAS, 40, phases=phases)
    naive = errors_mm([replace(m, pose=replace(m.pose, time_s=m.index / 30)) for m in ignored])
    assert np.sqrt(np.mean(naive[5:] ** 2)) > 0.15


def test_covariance_of_the_prediction_is_honest():
    """Innovations of the filter, in its own standard deviations, are of order one."""
    measured, _, tracker = run(RAVEN, one_body(), CAMERAS, 30)
    last = measured[-1].pose
    ahead = tracker.motion(last.time_s + 1 / 30)
    error = ahead.world_from_body.difference(path(last.time_s + 1 / 30))
    assert error @ np.linalg.solve(ahead.covariance, error) < 22.5
    assert np.sqrt(np.trace(ahead.covariance[:3, :3])) < 5


def test_a_body_known_from_elsewhere_is_looked_for_there_unless_tracking_knows_better():
    """Before anything is seen, and while it is tracked: of two places the one better known."""
    measured, _, tracker = run(RAVEN, one_body(), CAMERAS, 10)
    last = measured[-1].pose
    aside = replace(
        last,
        world_from_body=RigidTransform(
            last.world_from_body.rotation, last.world_from_body.translation + np.array([9.0, 0, 0])
        ),
        time_s=last.time_s + 1 / 30,
        covariance=np.diag(np.repeat([4.0, 0.05], 3) ** 2),
    )
    for known_mm, expected_mm in ((4.0, 0.0), (0.2, 9.0)):
        sds = np.repeat([known_mm, 0.05], 3)
        tracker.begin_near(replace(aside, covariance=np.diag(sds**2)))
        there = tracker.motion(aside.time_s).world_from_body.translation
        moved = there - path(aside.time_s).translation
        assert moved[0] == pytest.approx(expected_mm, abs=1.5)


def test_hidden_balls_come_back_at_once():
    hidden = lambda ball, camera, t: camera in ("cam0", "cam1") and 0.2 < t < 0.4
    measured, detectors, _ = run(RAVEN, one_body(), CAMERAS, hide=hidden)
    assert all(m.pose is not None for m in measured)
    assert all(d.searched == 1 for d in detectors.values())
    dark = measured[8]
    assert {v.reason for v in dark.views if v.camera == "cam0"} == {Reason.NOT_FOUND}
    assert all(v.state is State.EFFECTIVE for v in measured[-1].views)


def test_found_again_after_everything_was_hidden():
    hidden = lambda ball, camera, t: 0.2 < t < 0.4
    measured, detectors, _ = run(RAVEN, one_body(), CAMERAS, 30, hide=hidden)
    lost = [m.index for m in measured if m.pose is None]
    assert lost == [7, 8, 9, 10, 11]
    assert all(m.reason for m in measured if m.pose is None)
    assert all(m.status is Status.OK for m in measured[12:])
    assert all(2 <= d.searched <= 5 for d in detectors.values())
    assert np.max(errors_mm(measured[12:])) < 0.2


def test_one_wrong_detection_is_suspended_by_name_and_recovers():
    wrong = lambda ball, camera, t: (
        np.array([4.0, 3.0]) if (ball, camera) == ("red", "cam2") and 0.29 < t < 0.31 else 0.0
    )
    measured, _, _ = run(RAVEN, one_body(), CAMERAS, bias=wrong)
    view = next(v for v in measured[9].views if (v.ball, v.camera) == ("red", "cam2"))
    assert view.state is State.SUSPENDED
    assert view.reason in (Reason.INCONSISTENT, Reason.JUMPED)
    after = [
        next(v for v in m.views if (v.ball, v.camera) == ("red", "cam2")).reason
        for m in measured[10:12]
    ]
    assert after == [Reason.RECOVERING, Reason.NONE]
    assert np.max(errors_mm(measured[1:])) < 0.15


def test_a_camera_knocked_aside_is_flagged_and_left_out():
    knocked = lambda ball, camera, t: np.array([6.0, 0]) if camera == "cam1" and t > 0.3 else 0.0
    measured, _, _ = run(RAVEN, one_body(), CAMERAS, bias=knocked)
    assert measured[5].pose.flags == ()
    for m in measured[11:]:
        assert any("cam1" in flag for flag in m.pose.flags)
    assert np.max(errors_mm(measured[1:])) < 0.3


def test_no_ball_and_too_few_balls_give_no_pose():
    for keep in ((), ("green",), ("green", "red")):
        hidden = lambda ball, camera, t, keep=keep: ball not in keep
        measured, _, _ = run(RAVEN, one_body(), CAMERAS, 4, hide=hidden)
        assert all(m.pose is None and m.status is Status.LOST for m in measured)
        assert all(m.reason for m in measured)


def test_a_second_identical_body_at_the_start_gives_no_pose():
    other = RigidTransform.from_rotvec([0, 0, 1.5], TARGET + np.array([90.0, -40, 20]))
    two = lambda t: [(RAVEN, path(t)), (RAVEN, other)]
    measured, _, _ = run(RAVEN, two, CAMERAS, 5, sharp=False)
    assert all(m.pose is None for m in measured)
    assert all("two bodies" in m.reason for m in measured)


def test_a_second_identical_body_later_on_does_not_confuse():
    other = RigidTransform.from_rotvec([0, 0, 1.5], TARGET + np.array([90.0, -40, 20]))
    two = lambda t: [(RAVEN, path(t)), *([(RAVEN, other)] if t > 0.1 else [])]
    measured, _, _ = run(RAVEN, two, CAMERAS, 20)
    assert all(m.status is Status.OK for m in measured)
    assert np.max(errors_mm(measured)) < 0.2


def test_a_camera_upside_down_is_named():
    c = CAMERAS["cam2"]
    pose = c.world_from_camera
    rolled = RigidTransform(pose.rotation @ np.diag([-1.0, -1, 1]), pose.translation)
    assumed = {**CAMERAS, "cam2": Camera("cam2", c.intrinsics, rolled)}
    measured, _, _ = run(RAVEN, one_body(), CAMERAS, 6, assumed=assumed, start_s=1.0)
    for m in measured:
        if m.pose is not None:
            assert any("cam2" in flag for flag in m.pose.flags)
            assert errors_mm([m])[0] < 1.0


@pytest.mark.parametrize("pair", [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam3")])
def test_swapped_calibrations_are_never_a_confident_wrong_pose(pair):
    a, b = pair
    assumed = dict(CAMERAS)
    for here, there in ((a, b), (b, a)):
        assumed[here] = Camera(here, CAMERAS[there].intrinsics, CAMERAS[there].world_from_camera)
    for start_s in (0.0, 1.0, 2.0):
        measured, _, _ = run(RAVEN, one_body(), CAMERAS, 6, assumed=assumed, start_s=start_s)
        for m in measured:
            assert m.pose is None or m.pose.flags


def test_a_wrong_body_file_is_flagged_or_refused():
    shrunk = Body("33", tuple(replace(b, center_mm=b.center_mm * 33 / 38) for b in RAVEN.balls))
    world = lambda t: [(RAVEN, path(t))]
    measured, _, _ = run(shrunk, world, CAMERAS, 6)
    assert all(m.pose is None or m.pose.flags for m in measured)


def test_a_long_pause_starts_a_new_search():
    _, _, tracker = run(RAVEN, one_body(), CAMERAS, 5)
    assert tracker.motion(0.2) is not None
    late = next(iter(frame_sets(CAMERAS, 1, start_s=3.0)))
    assert all(len(e) == 0 for e in tracker.expect(late).values())


@pytest.mark.parametrize(
    ("sd", "followed"),
    [
        ((0.1, 0.1, 0.1, 0.01, 0.01, 0.01), True),
        ((30.0, 0.1, 0.1, 0.01, 0.01, 0.01), False),
        ((0.1, 0.1, 0.1, 0.01, 0.01, 2.0), False),
    ],
)
def test_a_pose_less_certain_than_a_ball_is_searched_again(sd, followed):
    """Windows as large as the picture would be followed from one wrong ball to the next."""
    measured, _, tracker = run(RAVEN, one_body(), CAMERAS, 5)
    last = measured[-1]
    pose = replace(last.pose, covariance=np.diag(np.square(sd)))
    tracker.conclude(
        next(frame_sets(CAMERAS, 1, start_s=5 / 30)), last.views, last.positions, pose, {}
    )
    assert (tracker.motion(0.2) is not None) == followed
