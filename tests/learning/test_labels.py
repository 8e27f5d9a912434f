"""Labels that are no errors of the robot: a frame, a tool, a clock, kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.registration import recorded, schema, ur5e
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots import RobotLog
from measure_learning.core import AssemblySettings, PoseTrack, assemble
from measure_learning.core.causes import LabelFacts

SLIP = RigidTransform.from_rotvec(np.deg2rad([6.0, -8.0, 0.0]), [30.0, 30.0, 26.5])


@pytest.fixture(scope="module")
def pair() -> tuple[PoseTrack, RobotLog]:
    """The tip itself in the base's frame: calibrated as the paper does."""
    arm = recorded(1, seconds=40.0, frame_hz=8.0)
    positions = arm.true_tip_mm + np.random.default_rng(0).normal(0, 0.05, arm.true_tip_mm.shape)
    track = replace(arm.track, positions_mm=positions, rotations=None, pose_covariances=None)
    return track, replace(arm.log, times_s=arm.log.times_s - arm.clock_offset_s)


def test_the_robots_own_errors_are_labels(pair: tuple[PoseTrack, RobotLog]) -> None:
    data, (facts,) = assemble([pair])
    assert facts.doubts == ()
    labels = LabelFacts.of(data)
    errors = data.errors_mm[data.usable]
    assert labels.rms_mm == pytest.approx(np.sqrt((errors**2).sum(axis=1).mean()))
    np.testing.assert_allclose(labels.largest_mm, np.abs(errors).max(axis=0))


def test_a_world_that_is_turned_is_refused_with_the_cure(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    slipped = replace(track, positions_mm=SLIP.apply(track.positions_mm))
    said = r"turned by 10\.\d deg and shifted by (49|50)\.\d mm explains them but for 0\.\d+ mm"
    with pytest.raises(
        EstimatorError, match=rf"ur5e_1: labels of \d+\.\d mm RMS .*{said}.*register"
    ):
        assemble([(slipped, log)])
    _, (facts,) = assemble([(slipped, log)], AssemblySettings(as_it_is=True))
    assert "turned by 10." in facts.doubts[0]


def test_a_tool_offset_is_refused_with_the_cure(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    turn = ur5e().pose(
        np.stack([np.interp(track.times_s, log.times_s, q) for q in log.states[:, :6].T], 1)
    )
    off = replace(
        track, positions_mm=track.positions_mm + turn.rotation @ np.array([0.0, 30.0, 0.0])
    )
    with pytest.raises(
        EstimatorError, match=r"a tool offset of \(-?0\.\d, (29|30)\.\d, -?0\.\d\) mm explains"
    ):
        assemble([(off, log)])


def test_a_turned_world_and_a_tool_offset_are_both_named(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    turn = ur5e().pose(
        np.stack([np.interp(track.times_s, log.times_s, q) for q in log.states[:, :6].T], 1)
    )
    off = SLIP.apply(track.positions_mm + turn.rotation @ np.array([0.0, 40.0, 20.0]))
    words = (
        r"a world turned by (9\.9|10\.\d) deg and shifted by (49|50)\.\d mm and a tool offset of "
        r"\(-?0\.\d, (39|40)\.\d, (19|20)\.\d\) mm explain them but for 0\.\d+ mm"
    )
    with pytest.raises(EstimatorError, match=words):
        assemble([(replace(track, positions_mm=off), log)])


def test_a_given_clock_that_is_off_is_refused(pair: tuple[PoseTrack, RobotLog]) -> None:
    with pytest.raises(EstimatorError, match=r"a clock that is \+(79|80)\.\d ms off explains them"):
        assemble([pair], AssemblySettings(clock_offset_s=-0.08))


def test_kinematics_that_contradict_the_log_are_named(pair: tuple[PoseTrack, RobotLog]) -> None:
    """Another tool in robot.toml, another base, and a wrong table."""
    track, log = pair
    chain = ur5e()
    tool, links = np.eye(4), [joint.link.copy() for joint in chain.joints]
    tool[2, 3] = 25.0
    links[0], links[2] = links[0] @ np.diag([-1.0, -1, 1, 1]), links[2]
    turned = replace(chain, joints=(replace(chain.joints[0], link=links[0]), *chain.joints[1:]))
    links[2][0, 3] += 60.0
    longer = (*chain.joints[:2], replace(chain.joints[2], link=links[2]), *chain.joints[3:])
    for other, said in (
        (replace(chain, tool=tool), r"25\.0 mm .*with tool_mm = \[0\.0, 0\.0, 0\.0\]"),
        (turned, r"the log's base is turned by 180\.0 deg and shifted by 0\.0 mm"),
        (replace(chain, joints=longer), r"is --robot the right one, and are alpha_deg"),
    ):
        states = RobotLog(schema(other), log.times_s, log.states)
        with pytest.raises(EstimatorError, match=rf"the kinematics put the tip .*{said}"):
            assemble([(track, states)])


def test_a_scale_and_a_jump_of_the_cameras_are_named(pair: tuple[PoseTrack, RobotLog]) -> None:
    """Too small for a wrong frame, and still no errors of the robot's."""
    track, log = pair
    places, middle = track.positions_mm, track.positions_mm.mean(axis=0)
    late = track.times_s > track.times_s[0] + 22.0
    for moved, said in (
        (middle + 1.01 * (places - middle), r"are not all the robot's .* 1\.010\d times as"),
        (places + np.outer(late, [3.0, 4.0, 0.0]), r"base, moved by [45]\.\d mm .*after apart"),
    ):
        with pytest.raises(EstimatorError, match=said):
            assemble([(replace(track, positions_mm=moved), log)])
