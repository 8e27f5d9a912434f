"""Slips of a registration: each is undone, told by its own name, or refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.registration import Arm, recorded, ur5e
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots import RobotLog
from measure_learning.core import PoseTrack
from measure_learning.core.registration import LoggedTrack, RegisterOptions, register

MIRROR = np.diag([-1.0, 1, 1])


@pytest.fixture(scope="module")
def arm() -> Arm:
    return recorded(3, seconds=40.0, frame_hz=5.0)


def moved(track: PoseTrack, places: np.ndarray, turns: np.ndarray | None = None) -> PoseTrack:
    return replace(
        track, positions_mm=places, rotations=track.rotations if turns is None else turns
    )


def logged(log: RobotLog, change: Callable[[np.ndarray], np.ndarray]) -> RobotLog:
    """The log with other joints, and the tip that follows from them."""
    q = change(log.states[:, :6].copy())
    return replace(log, states=np.concatenate([q, ur5e().tip_mm(q)], axis=1))


def reversed_joint(q: np.ndarray) -> np.ndarray:
    return q * [1, 1, 1, 1, -1, 1]


def exchanged(q: np.ndarray) -> np.ndarray:
    return q[:, [0, 2, 1, 3, 4, 5]]


def jumped(track: PoseTrack) -> PoseTrack:
    late = track.times_s > 22.0
    return moved(track, track.positions_mm + np.outer(late, [3.0, 4.0, 0.0]))


@pytest.mark.parametrize(
    ("slip", "words"),
    [
        (lambda t, log: (moved(t, t.positions_mm @ MIRROR), log), "x is mirrored in the poses'"),
        (
            lambda t, log: (moved(t, t.positions_mm @ MIRROR, MIRROR @ t.rotations @ MIRROR), log),
            "of a left hand's axes",
        ),
        (lambda t, log: (t, logged(log, exchanged)), r"another order \(q0, q2, q1, q3, q4, q5 are"),
        (lambda t, log: (t, logged(log, reversed_joint)), "q4 turns the other way"),
        (lambda t, log: (moved(t, 1.01 * t.positions_mm), log), r"world is 1\.01\d\d times as"),
        (lambda t, log: (jumped(t), log), r"moved by [45]\.\d mm and 0\.\d+ deg at 2[12]\.\d s"),
        (lambda t, log: (t.inverted(), log), "fit when they are inverted: .*--eye-in-hand"),
        (
            lambda t, log: (t, RobotLog(log.schema, log.times_s[::125], log.states[::125])),
            "a state every 1 s, and between two of them the tip is known to",
        ),
    ],
    ids=["mirrored", "left hand", "exchanged", "reversed", "scale", "jump", "inverted", "1 Hz"],
)
def test_a_slip_is_told_by_its_name(
    arm: Arm, slip: Callable[[PoseTrack, RobotLog], tuple[PoseTrack, RobotLog]], words: str
) -> None:
    with pytest.raises(EstimatorError, match=words):
        register([LoggedTrack(*slip(arm.track, arm.log))], RegisterOptions())


@pytest.mark.parametrize(
    "slip",
    [
        lambda t, log: (t, log),
        lambda t, log: (replace(t, times_s=t.times_s + 1.764e9), log),
        lambda t, log: (t, replace(log, times_s=log.times_s + 30.0)),
    ],
    ids=["none", "clock since boot", "30 s late"],
)
def test_what_can_be_undone_is_undone(
    arm: Arm, slip: Callable[[PoseTrack, RobotLog], tuple[PoseTrack, RobotLog]]
) -> None:
    """Clocks of any origin; and the negative control: nothing is found where nothing is wrong."""
    found = register([LoggedTrack(*slip(arm.track, arm.log))], RegisterOptions())
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 3.0
    assert found.judgement["left_out"] == 0


def test_angles_that_jump_by_a_turn_have_not_moved(arm: Arm) -> None:
    def wrapped(q: np.ndarray) -> np.ndarray:
        q[:, 5] = np.mod(q[:, 5] - q[:, 5].mean(), 2 * np.pi)
        return q

    jumps = np.abs(np.diff(wrapped(arm.log.states[:, :6].copy())[:, 5])) > 3
    assert jumps.sum() > 5
    log = logged(arm.log, wrapped)
    found = register([LoggedTrack(arm.track, log)], RegisterOptions())
    assert found.judgement["rms_mm"] < 0.5
    assert found.judgement["left_out"] == 0


def test_outliers_are_left_out_before_anything_is_judged(arm: Arm) -> None:
    rng = np.random.default_rng(0)
    off = rng.random(len(arm.track.times_s)) < 0.05
    places = arm.track.positions_mm + 50 * off[:, None] * rng.normal(size=(len(off), 3))
    plain, found = (
        register([LoggedTrack(track, arm.log)], RegisterOptions())
        for track in (arm.track, moved(arm.track, places))
    )
    assert 0 < off.sum() - found.judgement["left_out"] + 1 <= 2
    assert found.judgement["rms_mm"] < 1.1 * plain.judgement["rms_mm"]
    wider = np.sqrt(np.diag(found.covariance)[:12] / np.diag(plain.covariance)[:12])
    assert wider.max() < 1.3


def test_cameras_on_the_flange(arm: Arm) -> None:
    """Done if it is said; refused if it is said and not so."""
    options = RegisterOptions(eye_in_hand=True)
    found = register([LoggedTrack(arm.track.inverted(), arm.log)], options)
    assert found.eye_in_hand
    assert found.values()["eye_in_hand"] is True
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 3.0
    plain = register([LoggedTrack(arm.track, arm.log)], RegisterOptions())
    points = [f.to_base(t).positions_mm
              for f, t in ((found, arm.track.inverted()), (plain, arm.track))]  # fmt: skip
    assert np.abs(points[0] - points[1]).max() < 1.0
    with pytest.raises(EstimatorError, match="leave out --eye-in-hand"):
        register([LoggedTrack(arm.track, arm.log)], options)


def test_a_clock_is_as_uncertain_as_slack_makes_it() -> None:
    """Half a degree of play in every joint delays the arm; so much is in the deviation."""
    one = recorded(5, seconds=40.0, frame_hz=10.0)
    q = one.log.states[:, :6]
    played, half = q.copy(), np.deg2rad(0.25)
    for k in range(1, len(q)):
        played[k] = np.clip(played[k - 1], q[k] - half, q[k] + half)
    true = ur5e(mm=0.5, deg=0.05, seed=5)
    at = one.track.times_s + one.clock_offset_s
    joints = np.stack([np.interp(at, one.log.times_s, c) for c in played.T], axis=1)
    seen = one.world_from_base @ true.pose(joints) @ one.flange_from_body
    rng = np.random.default_rng(1)
    seen = seen.perturb(
        0.05 * np.array([1, 1, 1, 0.05, 0.05, 0.05]) * rng.normal(size=(len(at), 6))
    )
    track = moved(one.track, seen.translation, seen.rotation)
    found = register([LoggedTrack(track, one.log)], RegisterOptions())
    off = abs(found.clock_offsets_s[track.name] - one.clock_offset_s)
    sd = np.sqrt(found.covariance[12, 12])
    assert off > 1e-3
    assert off < 2.5 * sd
    assert sd < 0.05


def test_a_body_that_creeps_on_the_tool_is_named(arm: Arm) -> None:
    """It turns about its own origin, so that no position shows it."""
    creep = np.clip(arm.track.times_s / 10.0 - 1.5, 0.0, 1.0)[:, None]
    turns = RigidTransform.from_rotvec(creep * np.array([0.0, 0.1, 0.0])).rotation
    assert arm.track.rotations is not None
    track = moved(arm.track, arm.track.positions_mm, arm.track.rotations @ turns)
    words = r"the body on the tool moved by \d\.\d mm and [456]\."
    with pytest.raises(EstimatorError, match=words):
        register([LoggedTrack(track, arm.log)], RegisterOptions())


def test_the_cameras_scale_is_named_to_a_thousandth() -> None:
    """Without the links in the estimate, base and tool take a part of it."""
    arm = recorded(2, seconds=40.0, frame_hz=5.0, true=ur5e(mm=0.3, deg=0.03, seed=2))
    track = moved(arm.track, 0.995 * arm.track.positions_mm)
    with pytest.raises(EstimatorError, match=r"times as large as the robot's, SD 0\.00") as told:
        register([LoggedTrack(track, arm.log)], RegisterOptions())
    named = re.search(r"world is (\d\.\d+) times", str(told.value))
    assert named
    assert abs(float(named[1]) - 0.995) < 0.001


def test_a_given_clock_is_held_against_the_motion(arm: Arm) -> None:
    """Computers that are a few ms apart are believed: a robot's own delay looks like that."""
    one = LoggedTrack(arm.track, arm.log)
    with pytest.raises(EstimatorError, match=r"given clock offset of .* leave out --clock-offset"):
        register([one], RegisterOptions(clock_offset_s=arm.clock_offset_s + 0.15))
    found = register([one], RegisterOptions(clock_offset_s=arm.clock_offset_s + 0.002))
    assert found.clock_offsets_s[arm.track.name] == pytest.approx(arm.clock_offset_s + 0.002)
