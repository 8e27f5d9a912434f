"""A UR5e's recordings that are not what their names say: each is refused in one line."""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import recorded
from measure.arrays import Floats
from measure.cli import main
from measure_learning.robots import find_schema

POSE = ["time_s", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"]
JOINTS = [f"actual_q_{k}" for k in range(6)]
TIP = [f"actual_TCP_pose_{k}" for k in range(6)]
Columns = dict[str, Floats]


def write(path: Path, columns: Columns) -> None:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


@pytest.fixture(scope="module")
def tables() -> tuple[Columns, Columns, Columns]:
    """Poses of the body; the log as RTDE writes it; true positions of the flange now and then."""
    arm = recorded(2, seconds=40.0, frame_hz=8.0)
    place, quats = arm.track.positions_mm, arm.track.table().world_from_body.quat_wxyz
    poses = dict(zip(POSE, np.column_stack([arm.track.times_s, place, quats]).T, strict=True))
    q, chain = arm.log.states[:, :6], find_schema("ur5e").chain
    tip = chain.pose(q)
    rows = np.column_stack([q, tip.translation / 1000, tip.rotvec])
    log = {"time_s": arm.log.times_s, **dict(zip([*JOINTS, *TIP], rows.T, strict=True))}
    at = np.column_stack([arm.track.times_s + arm.clock_offset_s, arm.true_tip_mm])[::8]
    return poses, log, dict(zip(POSE, at.T, strict=False))


@pytest.fixture(scope="module")
def home(tables: tuple[Columns, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as files, with what was made of them."""
    folder = tmp_path_factory.mktemp("ur5e")
    for name, table in zip(("poses", "log", "true"), tables, strict=True):
        write(folder / f"{name}.csv", table)
    pair = f"{folder}/poses.csv --robot-log {folder}/log.csv --robot ur5e"
    pair_out = f"--frame {folder}/frame.toml --cut-s 8 -o {folder}/data.parquet"
    follow = f"--true-positions {folder}/true.csv -o {folder}/out.csv"
    for words in (
        f"register {pair} -o {folder}/frame.toml",
        f"dataset {pair} {pair_out}",
        f"train {folder}/data.parquet -o {folder}/model.onnx --estimator ridge --folds 0",
        f"estimate {folder}/model.onnx --input {folder}/log.csv {follow}",
    ):
        assert main(words.split()) == 0
    return folder


def in_ms(columns: Columns) -> Columns:
    return columns | {"time_s": 1e3 * columns["time_s"]}


def in_metres(columns: Columns) -> Columns:
    return columns | {name: columns[name] / 1e3 for name in POSE[1:4]}


def scalar_last(columns: Columns) -> Columns:
    return columns | {a: columns[b] for a, b in zip(POSE[4:], POSE[5:] + POSE[4:5], strict=True)}


def in_degrees(columns: Columns) -> Columns:
    return columns | {name: np.degrees(columns[name]) for name in JOINTS}


def tip_in_mm(columns: Columns) -> Columns:
    return columns | {name: 1e3 * columns[name] for name in TIP[:3]}


def other_order(columns: Columns) -> Columns:
    """Joints by the alphabet: elbow, shoulder lift, shoulder pan, as ROS has them."""
    return columns | {a: columns[JOINTS[2 - k]] for k, a in enumerate(JOINTS[:3])}


def in_the_world(columns: Columns) -> Columns:
    x, y, z = (columns[name] for name in POSE[1:4])
    return columns | dict(zip(POSE[1:4], (y + 300.0, -x, z), strict=True))


PAIR = "poses.csv --robot-log log.csv --robot ur5e"
REGISTER = f"register {PAIR} -o x.toml"
DATASET = f"dataset {PAIR} --frame frame.toml -o x.parquet"
ESTIMATE = "estimate model.onnx --input log.csv -o x.csv"
FOLLOW = f"{ESTIMATE} --true-positions true.csv"


@pytest.mark.parametrize(
    ("file", "change", "commands", "said"),
    [
        ("log", in_degrees, [REGISTER, DATASET, ESTIMATE], "'q2' seems to turn 1. times round"),
        ("log", in_ms, [REGISTER], "States every 8 s hardly show speeds: if that is in s"),
        ("log", in_ms, [ESTIMATE], "a state every 8 s, and this model learnt from one every 0.125"),
        ("log", tip_in_mm, [REGISTER], r"1e\+03 times as far from the base: is that in mm"),
        ("log", tip_in_mm, [DATASET], "or these are not in mm"),
        ("log", tip_in_mm, [ESTIMATE], r"unlike the training, and .*1e\+03 times as far"),
        ("log", other_order, [REGISTER, ESTIMATE], "is --robot the right one, and are alpha_deg"),
        ("poses", in_metres, [REGISTER, DATASET], "spread by .* deg .RMS.: are they in metres"),
        ("poses", scalar_last, [REGISTER, DATASET], "inverted 0.*: qw, qx, qy, qz must stand in"),
        ("true", in_ms, [FOLLOW], "none of 40 true positions was measured within 0.05 s before a"),
        ("true", in_metres, [FOLLOW], "true: the measured positions look like metres"),
        ("true", in_the_world, [FOLLOW], "a world turned by 90.* explains them but for"),
    ],
)
def test_columns_that_are_not_what_they_are_called(
    home: Path, tables: tuple[Columns, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    file: str, change: Callable[[Columns], Columns], commands: list[str], said: str,
) -> None:  # fmt: skip
    for path in home.iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    write(Path(f"{file}.csv"), change(tables[("poses", "log", "true").index(file)]))
    for words in commands:
        capsys.readouterr()
        assert main(words.split()) == 2
        told = capsys.readouterr().err.splitlines()
        assert len(told) == 1
        assert re.search(said, told[0]), told[0]
        assert not list(Path().glob("x.*"))
