"""Twenty poses in the morning: chosen well, they give the day's zeros, in files that say so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.arrays import Floats, Ints
from measure.cli import main
from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import Split, evaluate, files, join, rezero, training
from measure_learning.core.recalibration import choose_poses
from measure_learning.onnx import OnnxModel
from measure_learning.robots import find_schema

pytest.importorskip("sklearn", reason="training needs the extra 'train'")

ZEROS = np.array([0.006, -0.004, 0.5, 0.02, -0.03, 0.03])
"""Of today, rad and mm."""


def day(name: str, seed: int, zeros: Floats, rows: int = 200) -> Dataset:
    """Labels of a dVRK arm all over its workspace, homed so, and with errors of its own."""
    rng, schema = np.random.default_rng(seed), find_schema("dvrk-psm")
    q = rng.uniform(-1, 1, (rows, 6)) * [0.5, 0.5, 40, 1.2, 0.9, 0.9] + [0, 0, 150, 0, 0, 0]
    own = 0.01 * np.sin(2 * q) * [1, 1, 30, 1, 1, 1]  # what all days have in common
    tip = schema.chain.tip_mm(q)
    errors = schema.chain.tip_mm(q + own + zeros) - tip + rng.normal(0, 0.3, (rows, 3))
    return Dataset(
        schema,
        np.concatenate([q * [1, 1, 1e-3, 1, 1, 1], tip], axis=1),
        0.4 * np.arange(rows),
        np.zeros(rows, dtype=np.int64),
        (name,),
        errors,
        np.tile(1e-4 * np.eye(3), (rows, 1, 1)),
        np.ones(rows, dtype=bool),
    )


def some(data: Dataset, rows: Ints) -> Dataset:
    """The same history, of which only these rows are measured."""
    usable = np.zeros(len(data), dtype=bool)
    usable[rows] = True
    return replace(data, usable=usable)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Learnt from five days, each homed otherwise, about the same middle."""
    drawn = np.random.default_rng(0).normal(0, 1, (6, 6))
    drawn -= drawn[:5].mean(axis=0)
    days = [day(f"day{k}", k, ZEROS * one) for k, one in enumerate(drawn)]
    split = Split(join(days[:5]), days[5], days[5])
    estimator = Registry.discover().build(Estimator, "ridge", {"features": "pose"})
    out = tmp_path_factory.mktemp("model") / "model.onnx"
    training.train(estimator, split, out, seed=0, report=quiet, checkpoint=out.with_suffix(".c"))
    return out


@pytest.fixture(scope="module")
def today() -> Dataset:
    return day("today", 10, ZEROS)


def left_mm(model: OnnxModel, today: Dataset, rows: Ints) -> float:
    """RMS of all other labels, re-zeroed by these."""
    offset = rezero(model, some(today, rows))[0].offset_mm(today.states)
    others = np.setdiff1d(np.arange(len(today)), rows)
    left = (today.errors_mm - model.predict(today).errors_mm - offset)[others]
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def test_chosen_poses_tell_more_than_others(model: Path, today: Dataset, tmp_path: Path) -> None:
    files.write_dataset(tmp_path / "may.parquet", today, [], "the workspace")
    words = ["recalibrate", str(model), str(tmp_path / "may.parquet")]
    assert main([*words, "-o", str(tmp_path / "poses.csv")]) == 0
    head, *lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert head.split(",")[:4] == ["pose", "row", "q1_cmd", "q2_cmd"]
    table = np.array([[float(number) for number in line.split(",")] for line in lines])
    rows = table[:, 1].astype(np.int64) - 1
    np.testing.assert_allclose(table[:, 2:], today.states[rows], rtol=1e-6, atol=1e-6)
    loaded, rng = OnnxModel.load(model), np.random.default_rng(1)
    drawn = [rng.choice(len(today), 20, replace=False) for _ in range(8)]
    assert left_mm(loaded, today, rows) < np.mean([left_mm(loaded, today, one) for one in drawn])
    chosen = choose_poses(loaded, tmp_path / "may.parquet", 20)
    assert 0.0 < chosen.sd_after_mm < 0.6 * chosen.sd_before_mm
    twice = some(today, np.repeat(np.arange(len(today)), 2))
    files.write_dataset(tmp_path / "twice.parquet", twice, [], "each pose twice")
    loaded.card = {"left_out": {"after_mm": 9.0}}
    rows = choose_poses(loaded, tmp_path / "twice.parquet", 20).rows
    assert len({*(rows // 2).tolist()}) == 20


PSM = """{"DH": {"joints": [
  {"name": "outer_yaw", "offset": 1.5708}, // as it comes
  {"name": "outer_insertion", "offset": -0.4318}]}}
"""


def test_a_morning_ends_in_the_arms_own_files(
    model: Path, today: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The zeros are today's; model, URDF and arm file hold them, and the certificate keeps."""
    files.write_dataset(tmp_path / "may.parquet", today, [], "the workspace")
    chosen = choose_poses(OnnxModel.load(model), tmp_path / "may.parquet", 20).rows
    files.write_dataset(tmp_path / "today.parquet", some(today, chosen), [], "twenty of them")
    (tmp_path / "psm.json").write_text(PSM)
    out = tmp_path / "today.onnx"
    words = ["recalibrate", str(model), str(tmp_path / "may.parquet"), "-o", str(out), "--json"]
    words += ["--measured", str(tmp_path / "today.parquet")]
    assert main([*words, "--arm-file", str(tmp_path / "psm.json")]) == 0
    said = json.loads(capsys.readouterr().out)
    held = json.loads(out.with_suffix(".certificate.json").read_text())
    assert held == {name: value for name, value in said.items() if name != "output"}
    assert said["poses"] == 20
    assert said["held_out_mm"] < 0.7 * said["before_mm"]
    assert said["inside_95"] >= 0.8
    assert sum(region["poses"] for region in said["regions"]) == len(today)
    assert len(said["recordings"]) == 5
    assert "recalibrated" in out.with_suffix(".certificate.md").read_text()
    # The model of today: what it states holds, and it is the old one with the offset.
    before, after = OnnxModel.load(model), OnnxModel.load(out)
    rest = np.setdiff1d(np.arange(len(today)), chosen)
    result = evaluate(some(today, rest), after.predict(today))
    assert result.after.rms_mm < 0.5 * evaluate(today, before.predict(today)).after.rms_mm
    assert 0.5 < result.consistency**0.5 < 1.2
    zeroing = rezero(before, some(today, chosen))[0]
    moved = before.predict(today).errors_mm + zeroing.offset_mm(today.states)
    np.testing.assert_allclose(after.predict(today).errors_mm, moved, atol=2e-3)
    # The robot of today: the same offset, to 1 um.
    robot = find_schema(str(out.with_suffix(".urdf")))
    nominal = today.schema.chain.tip_mm(today.joints)
    off = robot.chain.tip_mm(today.joints) - nominal - zeroing.offset_mm(today.states)
    assert np.abs(off).max() < 1e-3
    text = out.with_suffix(".psm.json").read_text()
    assert f'"offset": {1.5708 + zeroing.joints()[0][0]:.9g}}}, // as it comes' in text
    assert f'"offset": {-0.4318 + zeroing.joints()[0][2] / 1e3:.9g}}}' in text


def test_a_day_like_the_training_is_left_as_it_is(model: Path, tmp_path: Path) -> None:
    """No zeros are found where there are none, and a morning may follow another."""
    calm = day("calm", 11, 0.0 * ZEROS)
    files.write_dataset(tmp_path / "calm.parquet", calm, [], "calm")
    words = ["recalibrate", str(model), str(tmp_path / "calm.parquet"), "--measured"]
    words += [str(tmp_path / "calm.parquet"), "-o", str(tmp_path / "calm.onnx")]
    assert main(words) == 0
    held = json.loads((tmp_path / "calm.certificate.json").read_text())
    zeros = [zero["zero"] * (np.pi / 180 if zero["unit"] == "deg" else 1) for zero in held["zeros"]]
    assert (np.abs(zeros) < 0.5 * np.abs(ZEROS)).all()
    again = [word.replace("calm.onnx", "again.onnx") for word in words]
    again[1] = str(tmp_path / "calm.onnx")
    assert main(again) == 0
    one, two = (OnnxModel.load(tmp_path / f"{name}.onnx") for name in ("calm", "again"))
    apart = one.predict(calm).errors_mm - two.predict(calm).errors_mm
    assert np.abs(apart).max() < 0.2


def test_what_tells_too_little_is_refused(
    model: Path, today: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    may, one = tmp_path / "may.parquet", tmp_path / "one.parquet"
    files.write_dataset(may, today, [], "the workspace")
    files.write_dataset(one, some(today, np.arange(5)), [], "five poses")
    far = replace(today, states=today.states + np.array([2.0, *[0.0] * 8]))
    files.write_dataset(tmp_path / "far.parquet", far, [], "another place")
    for words, said in (
        (f"{may} -o p.csv --count 5", "choose 12 or more"),
        (f"{may} -o p.csv --count 500", "has 200 poses to choose 500 from"),
        (f"{may} -o p.txt", "must end with .csv"),
        (f"{may} -o p.csv --arm-file {may}", "give --measured"),
        (f"{tmp_path}/far.parquet -o p.csv", "in 0 of 200 poses the joints are where"),
        (f"{may} -o t.onnx --measured {one}", "at least 10 measured states, got 5"),
        (f"{may} -o t.csv --measured {may}", "must end with .onnx"),
    ):
        place = words.replace("-o ", f"-o {tmp_path}/")
        assert main(["recalibrate", str(model), *place.split()]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("[pt].*"))
