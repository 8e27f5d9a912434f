"""A robot registered from places at which it stood still, by tables on the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.registration import Arm, recorded, robot_toml, schema, stopped, ur5e
from measure.cli import main
from measure.geometry import RigidTransform, chi_square_quantile
from measure.robots import RobotLog
from measure_learning.core.frames import read_frame
from measure_learning.core.registration import RegisterOptions, register_stops
from measure_learning.robots import write_log

POSE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")


def write_table(path: Path, columns: dict[str, Any]) -> Path:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, "%.9f", delimiter=",", header=",".join(columns), comments="")
    return path


def columns_of(arm_seed: int, count: int) -> tuple[dict[str, Any], dict[str, Any], Arm]:
    """Poses and joints of stops, as columns of a table."""
    stops, arm = stopped(arm_seed, count)
    place = stops.poses.world_from_body
    values = np.concatenate([place.translation, place.quat_wxyz], axis=1)
    poses = dict(zip(POSE, values.T, strict=True))
    return poses, {f"q{k}": stops.states[:, k] for k in range(6)}, arm


@pytest.fixture
def robot(tmp_path: Path) -> str:
    path = tmp_path / "robot.toml"
    path.write_text(robot_toml().replace("position =", "# position ="))
    names = ", ".join(f'{{name = "q{k}", unit = "rad"}}' for k in range(6))
    text = "\n".join(
        line for line in path.read_text().splitlines() if "position" not in line
    ).replace(robot_toml().splitlines()[2], f"features = [{names}]")
    path.write_text(text)
    return str(path)


def registered(*args: object) -> tuple[int, Path]:
    out = Path(str(args[0])).with_name("frame.toml")
    words = ["register", *map(str, args[1:]), "-o", str(out), "--overwrite", "--json"]
    return main(words), out


def test_eight_stops_in_one_table_give_base_and_tool(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, joints, arm = columns_of(4, 8)
    table = write_table(tmp_path / "stops.csv", poses | joints)
    code, out = registered(table, "--stops", table, "--robot", robot)
    assert code == 0
    said = json.loads(capsys.readouterr().out)
    found = read_frame(out)
    assert found.clock_offsets_s == {}
    assert said["clock_offset_s"] == {}
    assert len(found.covariance_order) == 12
    d = np.concatenate(
        [
            found.world_from_base.difference(arm.world_from_base),
            found.flange_from_body.difference(arm.flange_from_body),
        ]
    )
    assert np.linalg.norm(d[:3]) < 4.0
    assert d @ np.linalg.solve(found.covariance, d) < chi_square_quantile(0.999, 12)
    assert len(found.judgement["next_pose"]["joints"]) == 6


def exchanged(poses: dict[str, Any], order: list[int]) -> dict[str, Any]:
    return {name: column[order] for name, column in poses.items()}


def pushed(poses: dict[str, Any], off_mm: dict[int, float]) -> dict[str, Any]:
    x = poses["x_mm"].copy()
    for row, value in off_mm.items():
        x[row] += value
    return poses | {"x_mm": x}


@pytest.mark.parametrize(
    ("count", "spoil", "said"),
    [
        (15, lambda p: p, []),
        (8, lambda p: p, []),
        (15, lambda p: pushed(p, {6: 47.0}), ["stop 7 is left out: it is 4[67].. mm"]),
        (8, lambda p: pushed(p, {2: -15.0}), ["stop 3 is left out: it is 1[456].. mm"]),
        (
            15,
            lambda p: pushed(p, {0: 15.0, 9: -15.0, 4: 30.0}),
            [f"stop {k} is left out: it is" for k in (1, 5, 10)],
        ),
        (
            15,
            lambda p: exchanged(p, [0, 1, 8, *range(3, 8), 2, *range(9, 15)]),
            [
                f"stop {a} is left out: the pose of its joints is that of stop {b}$"
                for a, b in ((3, 9), (9, 3))
            ],
        ),
    ],
    ids=["fifteen", "eight", "one bad", "one of eight", "three bad", "two exchanged"],
)
def test_a_bad_stop_is_named_and_left_out(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str],
    count: int, spoil: Callable[[dict[str, Any]], dict[str, Any]], said: list[str],
) -> None:  # fmt: skip
    poses, joints, arm = columns_of(2, count)
    table = write_table(tmp_path / "stops.csv", spoil(poses) | joints)
    code, out = registered(table, "--stops", table, "--robot", robot)
    assert code == 0
    facts = json.loads(capsys.readouterr().out)["judgement"]
    assert facts["left_out"] == len(said)
    for sentence, pattern in zip(facts.get("stops_left_out", []), said, strict=True):
        assert re.match(pattern, sentence)
    found = read_frame(out)
    d = np.concatenate(
        [
            found.world_from_base.difference(arm.world_from_base),
            found.flange_from_body.difference(arm.flange_from_body),
        ]
    )
    assert np.linalg.norm(d[:3]) < 3.0
    assert d @ np.linalg.solve(found.covariance, d) < chi_square_quantile(0.999, 12)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([*range(1, 15)], ": each pose is one row above its joints: 0.* mm are left"),
        ([*range(6), *range(7, 15)], "from stop 7 on each pose is one row above its joints"),
        ([*range(5), *range(4, 13)], "from stop [56] on each pose is one row below its joints"),
    ],
    ids=["all", "a pose is missing", "a pose is there twice"],
)
def test_rows_that_are_out_of_step_are_named(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str], order: list[int], words: str
) -> None:
    poses, joints, _ = columns_of(2, 15)
    fewer = {name: column[: len(order)] for name, column in joints.items()}
    table = write_table(tmp_path / "stops.csv", exchanged(poses, order) | fewer)
    assert registered(table, "--stops", table, "--robot", robot)[0] == 2
    assert re.search(words, capsys.readouterr().err)


def test_seven_stops_are_refused_with_how_many_are_needed(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, joints, _ = columns_of(4, 7)
    table = write_table(tmp_path / "stops.csv", poses | joints)
    assert registered(table, "--stops", table, "--robot", robot)[0] == 2
    assert "7 poses with the robot's joints: at least 8 at rest" in capsys.readouterr().err


def test_two_tables_of_stops_need_no_clock(tmp_path: Path, robot: str) -> None:
    """At the same instants, 7 s apart: which no robot logs, so that ms were taken for their unit;
    and the log by a clock of its own, with a row that has no pose."""
    poses, joints, arm = columns_of(5, 16)
    at = 2.0 + 7.0 * np.arange(16)
    table = write_table(tmp_path / "poses.csv", {"time_s": at} | poses)
    log = write_table(tmp_path / "log.csv", {"timestamp": at} | joints)
    first, out = registered(table, table, "--robot-log", log, "--robot", robot)
    assert first == 0
    one = read_frame(out)
    assert one.judgement["poses"] == 16
    more = {name: np.insert(column, 5, column[5] + 0.3) for name, column in joints.items()}
    own = np.insert(at, 5, at[4] + 3.0) + 12345.0
    other = write_table(tmp_path / "log.csv", {"time_s": own} | more)
    assert registered(table, table, "--robot-log", other, "--robot", robot)[0] == 0
    two = read_frame(out)
    assert two.judgement["poses"] == 16
    assert np.linalg.norm(two.world_from_base.difference(one.world_from_base)[:3]) < 1e-3
    assert np.linalg.norm(one.world_from_base.difference(arm.world_from_base)[:3]) < 4.0


def test_pictures_while_standing_and_a_whole_log(tmp_path: Path, robot: str) -> None:
    """One pose a stop, a log at 100 Hz that moves between: matched by rests, clocks 40 s apart."""
    poses, joints, arm = columns_of(6, 12)
    q = np.column_stack(list(joints.values()))
    rng = np.random.default_rng(0)
    starts = np.cumsum(rng.uniform(4.0, 9.0, 12))
    knots = np.concatenate([[s, s + 2.0] for s in starts])
    times = np.arange(starts[0], starts[-1] + 2.0, 0.01)
    logged = np.stack([np.interp(times, knots, np.repeat(c, 2)) for c in q.T], axis=1)
    states = np.concatenate([logged, ur5e().tip_mm(logged)], axis=1)
    write_log(tmp_path / "log.csv", RobotLog(schema(ur5e()), times + 40.0, states))
    table = write_table(tmp_path / "poses.csv", {"time_s": starts + 1.0} | poses)
    log = tmp_path / "log.csv"
    code, out = registered(table, table, "--robot-log", log, "--robot", robot)
    assert code == 0
    found = read_frame(out)
    assert found.judgement["poses"] == 12
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 5.0


def test_a_log_at_1_hz_of_a_robot_that_stands_is_enough(tmp_path: Path, robot: str) -> None:
    """Pictures all the time, which move between the stops too."""
    _, joints, arm = columns_of(7, 12)
    q = np.column_stack(list(joints.values()))
    starts = 6.0 * np.arange(12)
    knots = np.concatenate([[s, s + 3.5] for s in starts])
    rng = np.random.default_rng(0)

    def at(times: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(times, knots, np.repeat(c, 2)) for c in q.T], axis=1)

    times = np.arange(0.0, starts[-1] + 3.5, 0.1)
    seen = arm.world_from_base @ ur5e(mm=0.5, deg=0.05, seed=7).pose(at(times))
    seen = (seen @ arm.flange_from_body).perturb(0.02 * rng.normal(size=(len(times), 6)) * 0.05)
    values = np.concatenate([seen.translation, seen.quat_wxyz], axis=1)
    table = write_table(
        tmp_path / "poses.csv", {"time_s": times} | dict(zip(POSE, values.T, strict=True))
    )
    slow = np.arange(0.3, times[-1])
    logged = dict(zip(joints, at(slow).T, strict=True))
    log = write_table(tmp_path / "log.csv", {"time_s": slow + 9.0} | logged)
    code, out = registered(table, table, "--robot-log", log, "--robot", robot)
    assert code == 0
    found = read_frame(out)
    assert 8 <= found.judgement["poses"] <= 12
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 5.0


def test_a_log_of_the_tools_poses_is_enough(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In metres and rotation vectors; links cannot be fitted to it, which is said."""
    one = recorded(2, seconds=30.0, frame_hz=8.0)
    values = np.concatenate(
        [one.track.positions_mm, RigidTransform(one.track.rotations, np.zeros(3)).quat_wxyz], axis=1
    )
    table = write_table(
        tmp_path / "poses.csv",
        {"time_s": one.track.times_s} | dict(zip(POSE, values.T, strict=True)),
    )
    tool = ur5e().pose(one.log.states[:, :6])
    stated = np.concatenate([tool.translation / 1e3, tool.rotvec], axis=1)
    tcp = {f"actual_TCP_pose_{k}": stated[:, k] for k in range(6)}
    log = write_table(tmp_path / "tcp.csv", {"timestamp": one.log.times_s} | tcp)
    source = (table, "--robot-log", log, "--robot", robot)
    code, out = registered(table, *source)
    assert code == 0
    found = read_frame(out)
    assert np.linalg.norm(found.world_from_base.difference(one.world_from_base)[:3]) < 3.0
    assert np.linalg.norm(found.flange_from_body.difference(one.flange_from_body)[:3]) < 2.0
    assert "next_pose" not in found.judgement
    assert registered(table, *source, "--kinematics")[0] == 2
    assert "no joints whose links can be fitted" in capsys.readouterr().err


def test_a_slip_of_stops_is_named(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, joints, _ = columns_of(5, 16)
    wrong = joints | {"q4": -joints["q4"]}
    table = write_table(tmp_path / "stops.csv", poses | wrong)
    assert registered(table, "--stops", table, "--robot", robot)[0] == 2
    assert "q4 turns the other way" in capsys.readouterr().err


def test_false_stops_are_left_out(tmp_path: Path, robot: str) -> None:
    poses, joints, _ = columns_of(5, 30)
    good = write_table(tmp_path / "stops.csv", poses | joints)
    code, out = registered(good, "--stops", good, "--robot", robot)
    assert code == 0
    without = read_frame(out)
    poses["x_mm"][[3, 17]] += 50.0
    table = write_table(tmp_path / "stops.csv", poses | joints)
    code, out = registered(table, "--stops", table, "--robot", robot)
    assert code == 0
    found = read_frame(out)
    assert found.judgement["left_out"] == 2
    assert found.judgement["rms_mm"] < 1.0
    assert np.linalg.norm(found.world_from_base.difference(without.world_from_base)[:3]) < 1.0


def test_more_stops_where_they_are_asked_for_shrink_the_deviations() -> None:
    """The pose that is named is better than a repetition of one that is there."""
    stops, _ = stopped(8, 8)
    found = register_stops([stops], schema(ur5e()), RegisterOptions(kinematics=True))
    helps = found.judgement["next_pose"]
    assert 0.3 < helps["base_sd_ratio"] <= 1.0
    assert helps["units"] == ["deg"] * 6
    many = register_stops([stopped(8, 30)[0]], schema(ur5e()), RegisterOptions(kinematics=True))
    assert np.trace(many.covariance[:3, :3]) < np.trace(found.covariance[:3, :3])
