"""Reasons to doubt a pose, each with what is no reason: also errors that a fit hides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.measuring import Status
from measure.measuring.tracking.pose_checks import PoseChecks, ResidualTable, single_view_balls
from measure.measuring.tracking.settings import PredictiveConfig
from measure.model import BallView, Detection, Pose
from measure.model.observations import Reason, State
from tests.measurements import BODY, CAMERAS, measurement
from tests.scenes import FOUR, RAVEN, TARGET, displaced, moved, ring
from tests.tracking_rig import run

EDGES_PX = 0.3
"""What edges of real balls are off by, each ball in each camera by its own, all the time."""


def path(time_s):
    shift = 25 * np.array([np.sin(2.4 * time_s), np.cos(1.7 * time_s), np.sin(1.1 * time_s)])
    rotvec = 0.3 * np.array([np.sin(1.5 * time_s), np.cos(1.2 * time_s), np.sin(0.7 * time_s)])
    return RigidTransform.from_rotvec(rotvec, TARGET + shift)


def edges(ball, camera, _):
    return np.random.default_rng([ord(ball[0]), int(camera[-1])]).normal(0, EDGES_PX, 2)


def measured(body, cameras, assumed_body=None, assumed=None, count=20, bias=edges):
    world = lambda t: [(body, path(t))]
    return run(assumed_body or body, world, cameras, count, assumed=assumed, bias=bias)[0]


def turned(cameras, name, degrees):
    pose = cameras[name].world_from_camera
    turn = [0, 0, 0, *pose.rotate(np.array([0, np.radians(degrees), 0]))]
    return {**cameras, name: moved(cameras[name], pose.perturb(turn))}


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=lambda body: body.name)
def test_edges_that_are_off_as_edges_are_raise_no_flag(body, count):
    found = measured(body, ring(count), count=60)
    assert [m.status for m in found] == [Status.OK] * 60


@pytest.mark.parametrize(("count", "degrees"), [(3, 0.25), (3, 0.4), (4, 0.25), (4, 0.4)])
def test_a_moved_camera_is_always_flagged(count, degrees):
    cameras = ring(count)
    found = measured(RAVEN, turned(cameras, "cam1", degrees), assumed=cameras)
    assert all(m.status is not Status.OK for m in found)


def test_an_offset_within_the_calibration_sd_is_not_flagged():
    """By 1.7 px: .06 degrees and .5 mm."""
    cameras = ring(4, pose_covariance=np.diag([0.3**2] * 3 + [0.0006**2] * 3))
    off = turned(cameras, "cam1", 0.06)
    aside = off["cam2"].world_from_camera.perturb([0.3, -0.3, 0.3, 0, 0, 0])
    off["cam2"] = moved(off["cam2"], aside)
    found = measured(RAVEN, off, assumed=cameras)
    assert [m.status for m in found] == [Status.OK] * len(found)
    assert all(v.state is State.EFFECTIVE for m in found for v in m.views)
    further = measured(RAVEN, turned(cameras, "cam1", 0.5), assumed=cameras)
    assert all(m.status is not Status.OK for m in further)


def test_balls_far_from_the_body_origin_are_tracked():
    """A tool's origin may lie behind a camera, where nothing has an image."""
    cameras = ring(4, pose_covariance=np.diag([0.1**2] * 3 + [0.0002**2] * 3))
    far = cameras["cam0"].center * 1.5 - TARGET
    tool = RAVEN.with_centers(RAVEN.centers - far)
    world = lambda t: [(tool, RigidTransform(np.eye(3), TARGET + far + [20 * t, 0, 0]))]
    found = run(tool, world, cameras, 20, bias=edges)[0]
    assert [m.status for m in found] == [Status.OK] * len(found)
    assert all(v.state is State.EFFECTIVE for m in found for v in m.views)


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize(
    ("body", "ball", "offset_mm"),
    [(RAVEN, "green", (3, 0, 0)), (FOUR, "blue", (0, 0, 5)), (FOUR, "white", (0, 3, 3))],
    ids=["green", "blue", "white"],
)
def test_a_body_file_with_a_misplaced_ball_is_flagged(body, ball, offset_mm, count):
    found = measured(body, ring(count), displaced(body, ball, offset_mm))
    assert all(m.status is not Status.OK for m in found)


def test_a_ball_that_two_cameras_see_elsewhere_is_named():
    """It is not believed there; the pose may rest on where a third sees it."""
    offset = lambda ball, camera, t: (
        np.array([9.0, -7.0]) if ball == "red" and camera in ("cam1", "cam2") and t > 0.3 else 0.0
    )
    found = measured(RAVEN, ring(4), bias=offset)
    assert all(m.status is Status.OK for m in found[:9])
    assert all(m.status is Status.FLAGGED for m in found[11:])
    flags = [flag for m in found if m.pose is not None for flag in m.pose.flags]
    assert any("ball red is seen elsewhere by cam1, cam2" in flag for flag in flags)


def test_a_single_wrong_detection_raises_no_flag():
    once = lambda ball, camera, t: (
        np.array([9.0, -7.0]) if (ball, camera) == ("red", "cam1") and 0.29 < t < 0.31 else 0.0
    )
    assert all(m.status is Status.OK for m in measured(RAVEN, ring(4), bias=once))


@pytest.mark.parametrize(("count", "flagged"), [(4, True), (5, False)])
def test_a_pose_of_few_sightings_is_flagged(count, flagged):
    one = measurement(0)
    table = ResidualTable(one.pose, one.views[:count], {}, BODY, CAMERAS, EDGES_PX)
    found = PoseChecks(PredictiveConfig()).soft(table, lambda: None)
    assert any(flag.startswith("only 4 sightings") for flag in found) == flagged


@pytest.mark.parametrize("cameras", [2, 4])
def test_a_ball_seen_by_one_camera_only_is_flagged(cameras):
    """In two cameras it is hidden from one: nobody else could show it."""
    rig = ring(cameras)
    one = run(RAVEN, lambda t: [(RAVEN, path(0.0))], rig, 1)[0][0]
    hidden = [
        replace(v, state=State.SUSPENDED, reason=Reason.NOT_FOUND, detection=None)
        if v.ball == "red" and v.camera != "cam0"
        else v
        for v in one.views
    ]
    table = ResidualTable(one.pose, one.views, {}, RAVEN, list(rig.values()), EDGES_PX)
    assert list(single_view_balls(table)) == []
    found = list(single_view_balls(replace(table, views=hidden)))
    assert bool(found) == (cameras == 4)
    if found:
        assert found[0].startswith("ball red is seen by one camera only, and not by cam1, cam2")


_IN_STEP, _OUT_OF_STEP = [0.0] * 4, [0.0, 0.01, 0.02, 0.03]


def _view(ball: str, camera: str, reason: Reason, seen: bool = True) -> BallView:
    state = State.SUSPENDED if reason else State.EFFECTIVE
    found = Detection(ball, camera, 0.0, np.zeros(2), 30.0, np.eye(2)) if seen else None
    return BallView(ball, camera, state, reason, found)


def _soft(checks, body, views, new_at_s=()):
    place = RigidTransform(np.eye(3), TARGET)
    pose = Pose(0.0, place, np.eye(6) * 1e-4, 0.01, 0.05, ("a", "b"), body.names)
    table = ResidualTable(pose, views, {}, body, list(ring(4).values()), 0.3)
    return checks.soft(table, lambda: None, new_at_s)


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
    flags = _soft(PoseChecks(PredictiveConfig()), RAVEN, [*right, *wrong, *unseen], times_s)
    assert any(flag.startswith("just found") for flag in flags) == flagged


@pytest.mark.parametrize("hidden", [True, False])
def test_what_another_ball_leaves_of_a_hidden_one_contradicts_nothing(hidden):
    """Green and red lie behind each other as cam0 sees them."""
    rig = ring(4)
    toward = rig["cam0"].center - TARGET
    x = toward / np.linalg.norm(toward) * (1 if hidden else -1)
    y = np.cross([0, 0, 1], x) / np.linalg.norm(np.cross([0, 0, 1], x))
    place = RigidTransform(np.stack([x, y, np.cross(x, y)], axis=1), TARGET)
    views = [_view("red", "cam0", Reason.INCONSISTENT), _view("red", "cam1", Reason.NONE)]
    views += [_view(ball, camera, Reason.NONE) for ball in ("green", "yellow") for camera in rig]
    pose = Pose(0.0, place, np.eye(6) * 1e-4, 0.01, 0.05, tuple(rig), RAVEN.names)
    table = ResidualTable(pose, views, {}, RAVEN, list(rig.values()), EDGES_PX)
    flags = PoseChecks(PredictiveConfig()).soft(table, lambda: None)
    assert any("ball red is seen elsewhere by cam0" in flag for flag in flags) != hidden


def test_a_ball_is_flagged_until_two_cameras_saw_it():
    checks = PoseChecks(PredictiveConfig())
    text = "has not been seen where"
    unseen = lambda views, body=FOUR: any(text in flag for flag in _soft(checks, body, views))
    three = [_view(ball, camera, Reason.NONE) for camera in "ab" for ball in FOUR.names[:3]]
    last = [_view(FOUR.names[3], camera, Reason.NONE) for camera in "ab"]
    assert unseen(three)
    assert unseen(last[:1])
    assert not unseen(last)
    assert not unseen([])
    checks.begin(())
    assert unseen([])
    assert not unseen([], RAVEN)
