"""A robot's base, the body on its tool and the clock, from one recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.registration import SWING_DEG, Arm, recorded, robot_toml, ur5e
from measure.cli import main
from measure.errors import EstimatorError
from measure.geometry import RigidTransform, chi_square_quantile
from measure.metrology.poses import SharedErrors
from measure_learning.core import assemble
from measure_learning.core.frames import RobotFrame, read_frame
from measure_learning.core.registration import LoggedTrack, RegisterOptions, register
from measure_learning.core.simulated import recording
from measure_learning.robots import find_schema, write_log
from measure_learning.robots.links import TURNS, with_link_errors
from measure_learning.simulator import simulate
from tests.metrology.recordings import write_run
from tests.results.conftest import BODY, CAMERAS

SHORT = {"seconds": 40.0, "frame_hz": 8.0}


@pytest.fixture(scope="module")
def arm() -> Arm:
    return recorded(0, **SHORT)


@pytest.fixture(scope="module")
def frame(arm: Arm) -> RobotFrame:
    return register([LoggedTrack(arm.track, arm.log)], RegisterOptions())


def off(frame: RobotFrame, arm: Arm) -> tuple[np.ndarray, float]:
    """Errors (13,) of a registered frame, and their squared Mahalanobis length."""
    d = np.concatenate(
        [
            frame.world_from_base.difference(arm.world_from_base),
            frame.flange_from_body.difference(arm.flange_from_body),
            [frame.clock_offsets_s[arm.track.name] - arm.clock_offset_s],
        ]
    )
    return d, float(d @ np.linalg.solve(frame.covariance[:13, :13], d))


def test_base_tool_and_clock_come_from_one_recording(arm: Arm, frame: RobotFrame) -> None:
    d, _ = off(frame, arm)
    assert np.degrees(np.linalg.norm(d[3:6])) < 0.15
    assert np.linalg.norm(d[:3]) < 1.5
    assert np.linalg.norm(d[6:9]) < 0.6
    assert abs(d[12]) < 0.5e-3
    assert frame.judgement["rms_mm"] < 0.45
    assert frame.judgement["rms_mm"] < frame.judgement["held_out_rms_mm"] < 0.6


@pytest.mark.parametrize("kinematics", [False, True])
def test_what_is_stated_covers_the_errors(kinematics: bool) -> None:
    """Of all 13 numbers together: in eight draws none far outside, and not all too cautious."""
    squares = []
    for seed in range(4):
        one = recorded(10 + seed, seconds=30.0, frame_hz=5.0)
        found = register([LoggedTrack(one.track, one.log)], RegisterOptions(kinematics))
        squares.append(off(found, one)[1])
    assert sum(square > chi_square_quantile(0.95, 13) for square in squares) <= 1
    assert max(squares) < chi_square_quantile(0.999, 13)
    assert np.mean(squares) > 1.0


def test_the_errors_of_the_links_are_fitted_and_named(arm: Arm) -> None:
    found = register([LoggedTrack(arm.track, arm.log)], RegisterOptions(kinematics=True))
    assert found.judgement["held_out_rms_mm"] < 0.12
    facts = found.kinematics
    kept = np.array(facts["sd"]) / np.array(facts["sd_before"])
    named = found.judgement["not_separable"][-1]
    assert "link1_z_deg" in named, "a turn of the first joint is one of the base"
    assert "link3_x_mm" not in named
    assert kept[facts["parameters"].index("link3_x_mm")] < 0.5


def test_recordings_share_a_frame_and_have_a_clock_each(arm: Arm, frame: RobotFrame) -> None:
    late = replace(arm.log, times_s=arm.log.times_s + 0.7)
    half = len(arm.track.times_s) // 2
    tracks = [
        replace(
            arm.track,
            name=name,
            **{
                key: getattr(arm.track, key)[rows]
                for key in (
                    "times_s",
                    "positions_mm",
                    "covariances",
                    "rotations",
                    "pose_covariances",
                )
            },
        )
        for name, rows in (("a", slice(0, half)), ("b", slice(half, None)))
    ]
    pairs = [LoggedTrack(tracks[0], arm.log), LoggedTrack(tracks[1], late)]
    found = register(pairs, RegisterOptions())
    apart = found.clock_offsets_s["b"] - found.clock_offsets_s["a"]
    assert apart == pytest.approx(0.7, abs=1e-3)
    assert np.linalg.norm(found.world_from_base.difference(frame.world_from_base)[:3]) < 0.5
    assert found.covariance_order[12:] == ("clock_offset_s.a", "clock_offset_s.b")


def test_a_robot_without_known_kinematics(arm: Arm) -> None:
    """The reported point alone: where it is on the body, and where the base is."""
    bare = replace(arm.log, schema=replace(arm.log.schema, chain=None, joints=()))
    found = register([LoggedTrack(arm.track, bare)], RegisterOptions())
    point = found.flange_from_body.inverse().translation
    true = arm.flange_from_body.inverse().translation
    assert np.linalg.norm(point - true) < 1.0
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[3:]) < 0.005
    assert "kinematics are not known" in found.judgement["not_separable"][0]


def across(error: np.ndarray, frame: RobotFrame, start: int) -> float:
    """Squared Mahalanobis length of three numbers' error where they are known to 100 mm."""
    P = frame.covariance[start : start + 3, start : start + 3]
    values, axes = np.linalg.eigh(P)
    return float(np.sum(((error @ axes)[values < 100.0**2]) ** 2 / values[values < 100.0**2]))


@pytest.mark.parametrize(
    ("swing", "said"),
    [
        ([0, 0, 0, 0, 0, 60], ("together along the axis", "turned together about the axis")),
        ([0, 15, 15, 30, 0, 0], ("together along the axis",)),
    ],
    ids=["one axis", "parallel axes"],
)
def test_what_a_motion_leaves_open_is_named_and_the_rest_delivered(
    swing: list[float], said: tuple[str, ...]
) -> None:
    one = recorded(0, **SHORT, swing_deg=np.array(swing, dtype=np.float64))
    given = RegisterOptions(clock_offset_s=one.clock_offset_s)
    found = register([LoggedTrack(one.track, one.log)], given)
    first = found.judgement["not_separable"][0]
    assert "not determined by this motion" in first
    assert [part in first for part in said] == [True] * len(said)
    assert ("turned together" in first) == (len(said) == 2)
    miss = found.flange_from_body.difference(one.flange_from_body)[:3]
    sd = np.sqrt(np.linalg.eigvalsh(found.covariance[6:9, 6:9]))
    assert sd[-1] > 300.0
    assert sd[0] < 10.0
    if len(said) == 1:  # across the axis the place of the tool is known
        assert across(miss, found, 6) < chi_square_quantile(0.999, 2)


def test_too_short_a_motion_is_refused_with_what_it_lacks(arm: Arm) -> None:
    short = recorded(0, seconds=12.0, frame_hz=8.0)
    with pytest.raises(EstimatorError, match=r"96 poses .* over 11\.9 s: at least 30 over 15 s"):
        register([LoggedTrack(short.track, short.log)], RegisterOptions())
    flat = LoggedTrack(replace(arm.track, rotations=None), arm.log)
    with pytest.raises(EstimatorError, match="positions alone; registering needs poses"):
        register([flat], RegisterOptions())


def test_wrong_kinematics_are_named() -> None:
    """A link of 30 mm too much, in the description and in the controller alike."""
    wrong = ur5e()
    link = wrong.joints[3].link.copy()
    link[0, 3] += 30.0
    joints = (*wrong.joints[:3], replace(wrong.joints[3], link=link), *wrong.joints[4:])
    one = recorded(3, **SHORT, known=replace(wrong, joints=joints))
    with pytest.raises(EstimatorError, match=r"leave \d\.\d mm .* link4_x_mm off by -(29|3\d)\."):
        register([LoggedTrack(one.track, one.log)], RegisterOptions())


def test_joints_that_are_not_those_of_the_poses_are_refused() -> None:
    """Of another order, the clock given: it ended in an unexplained error of linear algebra."""
    one = recorded(3, **SHORT)
    q = one.log.states[:, [2, 1, 0, 3, 4, 5]]
    log = replace(one.log, states=np.concatenate([q, ur5e().tip_mm(q)], axis=1))
    given = RegisterOptions(clock_offset_s=one.clock_offset_s)
    with pytest.raises(EstimatorError, match=r"in another order \(q2, q1, q0, q3, q4, q5 are"):
        register([LoggedTrack(one.track, log)], given)


def test_a_simulated_raven_says_what_it_cannot_separate() -> None:
    """Labels by the fitted frame are smaller than by the true one: it takes the constant part."""
    run = simulate(40.0, 5, log_hz=100.0)
    rows, rng = np.arange(10, len(run.times_s) - 10, 12), np.random.default_rng(5)
    world_from_base = RigidTransform.from_rotvec(rng.normal(0, 1, 3), rng.normal(0, 300, 3))
    seen = world_from_base @ run.world_from_tip[rows]
    sd = 0.05 * np.array([1, 1, 1, 0.05, 0.05, 0.05])
    seen = seen.perturb(sd * rng.normal(size=(len(rows), 6)))
    P = np.tile(np.diag(sd**2), (len(rows), 1, 1))
    track, log = recording(run, "raven", 5, frame_hz=15.0)
    poses = replace(
        track,
        times_s=run.times_s[rows],
        positions_mm=seen.translation,
        covariances=P[:, :3, :3],
        rotations=seen.rotation,
        pose_covariances=P,
    )
    found = register([LoggedTrack(poses, log)], RegisterOptions())
    said = found.judgement["not_separable"][0]
    assert "joints homed wrongly) move the tip as another base would" in said
    d = found.world_from_base.difference(world_from_base)
    assert d[:6] @ np.linalg.solve(found.covariance[:6, :6], d[:6]) < chi_square_quantile(0.99, 6)
    labels, truly = (
        np.linalg.norm(data.errors_mm[data.usable], axis=1).mean()
        for data, _ in (assemble([(found.to_base(poses), log)]), assemble([(track, log)]))
    )
    assert labels < 0.5 * truly


def test_from_the_command_line_to_labels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run and a log: refused as they are, with the command that helps; then labels of 0.5 mm."""
    one = recorded(7, **SHORT)
    run = write_run(tmp_path / "run", one.track.table())
    log, robot, frame = tmp_path / "robot.csv", tmp_path / "robot.toml", tmp_path / "frame.toml"
    write_log(log, one.log)
    robot.write_text(robot_toml())
    source = [str(run), "--robot-log", str(log), "--robot", str(robot)]
    pair = ["dataset", *source, "--out", str(tmp_path / "data.parquet"), "--json"]
    assert main(pair) == 2
    said = capsys.readouterr().err
    assert "explain" in said or "no clock offset" in said
    assert "measure register" in said
    assert main(["register", *source, "-o", str(frame), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["judgement"]["rms_mm"] < 0.7
    found = read_frame(frame)
    np.testing.assert_allclose(
        found.world_from_base.translation, one.world_from_base.translation, atol=2
    )
    np.testing.assert_allclose(printed["covariance"], found.covariance)
    clock = abs(one.clock_offset_s - printed["clock_offset_s"])
    assert clock < 1e-3
    assert main([*pair, "--frame", str(frame)]) == 0
    labels = json.loads(capsys.readouterr().out)["labels"]
    assert labels["rms_mm"] < 0.8
    assert max(labels["largest_mm"]) < 3.0
    assert main(["register", *source, "-o", str(frame), "--overwrite"]) == 0
    assert "mm on halves held out" in capsys.readouterr().out
    raven = ["dataset", str(run), "--robot-log", str(log), "--frame", str(frame)]
    assert main([*raven, "--out", str(tmp_path / "raven.parquet")]) == 2
    assert "is the frame of robot 'ur5e-test', not of 'raven2-left'" in capsys.readouterr().err


def test_errors_that_a_run_shares_are_in_the_covariance(arm: Arm) -> None:
    """Of cameras and body, they do not average out."""
    errors = SharedErrors(CAMERAS, BODY)
    alone, shared = (
        register([LoggedTrack(arm.track, arm.log, known)], RegisterOptions(kinematics=True))
        for known in (None, errors)
    )
    more = np.diag(shared.covariance)[:12] / np.diag(alone.covariance)[:12]
    assert np.all(more > 0.9)
    assert more.max() > 1.2


@pytest.mark.parametrize("moving", [[1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1]])
def test_joints_that_stand_exactly_still_leave_their_links_open(moving: list[int]) -> None:
    one = recorded(3, **SHORT, swing_deg=SWING_DEG * moving)
    for kinematics in (False, True):
        options = RegisterOptions(kinematics, largest_offset_s=2e9)  # no more is searched than is
        found = register([LoggedTrack(one.track, one.log)], options)
        miss = found.world_from_base.difference(one.world_from_base)[:3]
        assert miss @ np.linalg.solve(found.covariance[:3, :3], miss) < chi_square_quantile(0.99, 3)
        assert np.linalg.norm(miss) < 10.0


def test_mirrored_poses_are_refused_whatever_may_be_fitted() -> None:
    one = recorded(3, **SHORT)
    mirror = np.diag([-1.0, 1, 1])
    assert one.track.rotations is not None
    track = replace(
        one.track,
        positions_mm=one.track.positions_mm @ mirror,
        rotations=mirror @ one.track.rotations @ mirror,
    )
    options = RegisterOptions(kinematics=True, clock_offset_s=one.clock_offset_s)
    with pytest.raises(EstimatorError, match="mirrored"):
        register([LoggedTrack(track, one.log)], options)


def test_a_search_without_end_is_refused(arm: Arm) -> None:
    log = replace(arm.log, times_s=arm.log.times_s * 1e5)
    with pytest.raises(EstimatorError, match="too many to search"):
        register([LoggedTrack(arm.track, log)], RegisterOptions(largest_offset_s=2e9))


def test_the_measured_links_go_out_as_a_urdf_and_come_back(
    arm: Arm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And base and tool as the commands that publish them."""
    (tmp_path / "robot.toml").write_text(robot_toml())
    write_log(tmp_path / "log.csv", arm.log)
    place, quats = (
        arm.track.positions_mm,
        RigidTransform(arm.track.rotations, np.zeros(3)).quat_wxyz,
    )
    np.savetxt(
        tmp_path / "poses.csv",
        np.column_stack([arm.track.times_s, place, quats]),
        delimiter=",",
        header="time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz",
        comments="",
    )
    words = ["register", str(tmp_path / "poses.csv"), "--robot-log", str(tmp_path / "log.csv")]
    words += ["--robot", str(tmp_path / "robot.toml"), "-o", str(tmp_path / "frame.toml")]
    out, ur = tmp_path / "measured.urdf", tmp_path / "calibration.yaml"
    calib, launch = tmp_path / "cell.calib", tmp_path / "cell.launch.py"
    also = [word for path in (out, ur, calib, launch) for word in ("--also", str(path))]
    assert main([*words, *also]) == 2
    assert "give --kinematics" in capsys.readouterr().err
    assert main([*words, "--also", str(tmp_path / "cell.txt")]) == 2
    assert "its name must end with .urdf" in capsys.readouterr().err
    assert not (tmp_path / "frame.toml").exists()
    assert main([*words, *also, "--kinematics", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    values = np.array(said["kinematics"]["values"])
    errors = np.where(np.resize(TURNS, values.shape), np.deg2rad(values), values)
    measured, q = with_link_errors(ur5e(), errors), arm.log.states[::50, :6]
    for path, first in ((out, 0), (ur, 1)):
        schema = find_schema(str(path))
        assert schema.chain is not None
        names = [reading.terms[0][0] for reading in schema.joints]
        assert names == [f"q{k + first}" for k in range(6)]
        off = schema.chain.pose(q).difference(measured.pose(q))
        assert np.abs(off[:, :3]).max() < 1e-3  # 1 um
        assert np.abs(off[:, 3:]).max() < 1e-8
    held = yaml.safe_load(calib.read_text())
    assert held["parameters"]["calibration_type"] == "eye_on_base"
    camera, base = held["transform"], read_frame(tmp_path / "frame.toml").world_from_base
    quat = [camera["rotation"][name] for name in "wxyz"]
    place = [1e3 * camera["translation"][name] for name in "xyz"]
    off = (RigidTransform.from_quat_wxyz(quat, place) @ base).difference(RigidTransform.identity())
    assert np.abs(off).max() < 1e-6
    assert launch.read_text().count("static_transform_publisher") == 2
    assert f"'--x', '{base.translation[0] / 1e3:.9f}'" in launch.read_text()
    compile(launch.read_text(), "launch", "exec")
    assert np.linalg.norm(schema.chain.tip_mm(q) - ur5e().tip_mm(q), axis=1).max() > 0.1
    base = dict(zip(*[iter(said["static_transforms"][0].split()[4:])] * 2, strict=True))
    assert base["--frame-id"] == "world"
    shift = [1e3 * float(base[f"--{axis}"]) for axis in "xyz"]
    np.testing.assert_allclose(shift, said["world_from_base"]["translation_mm"], atol=1e-5)
    turn = [float(base[f"--q{axis}"]) for axis in "wxyz"]
    np.testing.assert_allclose(turn, said["world_from_base"]["quat_wxyz"], atol=1e-8)
