"""The tool's rotation as makers write it: the reading that fits the poses is taken and named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.registration import Arm, recorded, stopped, ur5e
from measure.cli import main
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure_learning.core import PoseTrack
from measure_learning.core.frames import read_frame
from measure_learning.core.registration import (
    LoggedTrack,
    RegisterOptions,
    choose_reading,
    turns_apart_deg,
)
from measure_learning.robots import find_schema
from measure_learning.robots.tool_poses import read_tool_poses

POSE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
Write = Callable[[Rotation], np.ndarray]


def euler(order: str, *, degrees: bool = True) -> Write:
    return lambda turn: turn.as_euler(order, degrees=degrees)


def w_first(turn: Rotation) -> np.ndarray:
    return turn.as_quat()[:, [3, 0, 1, 2]]


def write(path: Path, columns: dict[str, Any]) -> Path:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, "%.8g", delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture(scope="module")
def standing() -> tuple[PoseTrack, RigidTransform, Arm]:
    stops, arm = stopped(3, 16, true=ur5e())
    place = stops.poses.world_from_body
    P = stops.poses.covariances
    times = 2.0 + 6.5 * np.arange(16)
    track = PoseTrack("poses", times, place.translation, P[:, :3, :3], place.rotation, P)
    return track, ur5e().pose(stops.states[:, :6]), arm


@pytest.mark.parametrize(
    ("headings", "how", "maker"),
    [
        ("X Y Z A B C", euler("ZYX"), "kuka"),
        ("X Y Z A B C", euler("xyz"), "mitsubishi"),
        ("X Y Z A B C", euler("ZYZ"), "doosan"),
        ("X Y Z A_rad B_rad C_rad", euler("ZYZ", degrees=False), "doosan"),
        ("X Y Z W P R", euler("xyz"), "fanuc"),
        ("tcp.x (mm)|tcp.y (mm)|tcp.z (mm)|tcp.rx|tcp.ry|tcp.rz", euler("xyz"), "yaskawa"),
        ("x y z rx ry rz", euler("XYZ"), "staubli"),
        ("x y z rx ry rz", lambda turn: np.degrees(turn.as_rotvec()), "ur"),
        ("x y z rx ry rz", lambda turn: turn.as_rotvec(), "ur"),
        ("x y z q1 q2 q3 q4", w_first, "abb"),
        ("x y z q0 q1 q2 q3", lambda turn: turn.as_quat(), "ros"),
        ("x y z roll pitch yaw", euler("xyz"), "kuka"),
    ],
)
def test_what_fits_is_taken_and_its_rivals_are_named(
    tmp_path: Path, standing: tuple[PoseTrack, RigidTransform, Arm],
    headings: str, how: Write, maker: str,
) -> None:  # fmt: skip
    track, tool, _ = standing
    values = np.hstack([tool.translation, how(Rotation.from_matrix(tool.rotation))])
    names = headings.split("|") if "|" in headings else headings.split()
    path = write(
        tmp_path / "log.csv", {"time_s": track.times_s, **dict(zip(names, values.T, strict=True))}
    )
    readings, logs = zip(*read_tool_poses(path, find_schema("ur5e")), strict=True)
    apart = [turns_apart_deg(LoggedTrack(track, log), RegisterOptions()) for log in logs]
    best, words = choose_reading("log.csv", readings, apart)
    assert readings[best].angles == maker
    assert f"as {maker} writes them" in words
    assert words.count("writes them") == len(readings)
    assert ("--angles" in words) == (len(readings) > 1)
    log = logs[best]
    found = log.schema.chain.pose(log.schema.joint_positions(log.states))
    assert np.abs(found.difference(tool)).max() < 1e-3


@pytest.mark.parametrize("layout", ["T00", "m11", "flat by columns", "rotation", "no last row"])
def test_matrices_are_read(
    tmp_path: Path, standing: tuple[PoseTrack, RigidTransform, Arm], layout: str
) -> None:
    track, tool, _ = standing
    matrix = tool.matrix
    columns: dict[str, Any] = {"time_s": track.times_s}
    if layout == "flat by columns":
        flat = np.swapaxes(matrix, 1, 2).reshape(-1, 16)
        columns |= {f"O_T_EE[{k}]": flat[:, k] for k in range(16)}
    elif layout == "rotation":
        columns |= dict(zip("xyz", tool.translation.T, strict=True))
        columns |= {f"R{i}{j}": matrix[:, i, j] for i in range(3) for j in range(3)}
    else:
        name, first = ("m", 1) if layout == "m11" else ("T", 0)
        rows = 3 if layout == "no last row" else 4
        columns |= {
            f"{name}{i + first}{j + first}": matrix[:, i, j] for i in range(rows) for j in range(4)
        }
    path = write(tmp_path / "log.csv", columns)
    ((reading, log),) = read_tool_poses(path, find_schema("ur5e"))
    assert reading.angles == "matrix"
    found = log.schema.chain.pose(log.schema.joint_positions(log.states))
    assert np.abs(found.difference(tool)).max() < 1e-3


def test_readings_that_fit_alike_are_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A tool that turns about z alone: by A as KUKA, by C as Mitsubishi; a zero tells nothing."""
    rng = np.random.default_rng(1)
    turn = Rotation.from_euler(
        "ZYZ", np.column_stack([rng.uniform(-60, 60, 12), *[[0] * 12] * 2]), True
    )
    tool = RigidTransform(turn.as_matrix(), rng.normal(0, 200, (12, 3)))
    base = RigidTransform.from_rotvec([0.2, 0.3, -0.4], [500.0, 20.0, 60.0])
    seen = base @ tool @ RigidTransform.from_rotvec([0.1, 0.5, 0.2], [10.0, 0.0, 40.0])
    times = 7.0 * np.arange(12)
    values = np.hstack([seen.translation, seen.quat_wxyz])
    poses = write(
        tmp_path / "poses.csv", {"time_s": times, **dict(zip(POSE, values.T, strict=True))}
    )
    angles = dict(zip("ABC", turn.as_euler("ZYX", degrees=True).T, strict=True))
    place = dict(zip("XYZ", tool.translation.T, strict=True))
    log = write(tmp_path / "log.csv", {"time": times, **place, **angles})
    words = ["register", str(poses), "--robot-log", str(log), "--robot", "ur5e"]
    words += ["-o", str(tmp_path / "frame.toml"), "--overwrite"]
    assert main(words) == 2
    assert "as doosan writes them" in (said := capsys.readouterr().err)
    assert "say which with --angles" in said
    assert main([*words, "--angles", "abb"]) == 2
    assert "A, B, C are not as abb writes rotations" in capsys.readouterr().err
    assert main([*words, "--angles", "kuka"]) == 0
    assert "as kuka writes them" in caplog.messages[-1]


def test_stops_and_a_file_of_tum_are_registered(
    tmp_path: Path, standing: tuple[PoseTrack, RigidTransform, Arm],
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    track, tool, arm = standing
    angles = Rotation.from_matrix(tool.rotation).as_euler("xyz", degrees=True)
    log = dict(zip("XYZABC", np.hstack([tool.translation, angles]).T, strict=True))
    quats = Rotation.from_matrix(track.rotations).as_quat()
    seen = np.hstack([track.positions_mm, quats[:, [3, 0, 1, 2]]])
    both = {**dict(zip(POSE, seen.T, strict=True)), **log}
    tum = np.column_stack([track.times_s, track.positions_mm / 1e3, quats])
    np.savetxt(tmp_path / "poses.txt", tum, "%.9f", header="timestamp tx ty tz qx qy qz qw")
    write(tmp_path / "log.csv", {"time_s": track.times_s} | log)
    for words in (
        ["--stops", str(write(tmp_path / "stops.csv", both))],
        [str(tmp_path / "poses.txt"), "--robot-log", str(tmp_path / "log.csv")],
    ):
        out = tmp_path / "frame.toml"
        assert main(["register", *words, "--robot", "ur5e", "-o", str(out), "--overwrite"]) == 0
        assert "A, B, C as mitsubishi writes them" in caplog.messages[-1]
        found = read_frame(out)
        assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 0.5
        assert np.linalg.norm(found.flange_from_body.difference(arm.flange_from_body)[:3]) < 0.5


def test_angles_are_of_logs_without_joints(tmp_path: Path) -> None:
    track = recorded(0, seconds=1.0).track
    path = write(tmp_path / "log.csv", {"time_s": track.times_s, "x": track.times_s})
    with pytest.raises(EstimatorError, match="holds no pose of the tool"):
        read_tool_poses(path, find_schema("ur5e"))
