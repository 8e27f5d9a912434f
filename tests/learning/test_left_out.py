"""What an estimator promises is what it does on recordings that it has not seen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import evaluate, files, split_by_trajectory
from measure_learning.estimators import _training_set
from measure_learning.estimators._training_set import OutputUnits, TrainingSet
from measure_learning.robots import find_schema

pytest.importorskip("sklearn", reason="training needs the extra 'train'")


def _recordings(names: list[str], seed: int, rows: int = 60) -> Dataset:
    """Each recording works at a place of its own, with an offset of its own; two pieces each."""
    rng = np.random.default_rng(seed)
    count = 2 * rows
    joints, errors = [], []
    for _ in names:
        where = np.array([0.0, 0.0, 0.15, 0.0, 0.0, 0.0]) + rng.uniform(-0.3, 0.3, 6) * [
            1, 1, 0.1, 1, 1, 1
        ]  # fmt: skip
        joints.append(where + rng.uniform(-0.03, 0.03, (count, 6)) * [1, 1, 0.1, 1, 1, 1])
        errors.append(rng.normal(0, 1.0, 3) + rng.normal(0, 0.2, (count, 3)))
    q = np.concatenate(joints)
    schema = find_schema("dvrk-psm")
    tip = schema.chain.tip_mm(q * [1, 1, 1e3, 1, 1, 1])
    pieces = tuple(f"{name}/{half}" for name in names for half in range(2))
    return Dataset(
        schema,
        np.concatenate([q, tip], axis=1),
        np.tile(0.4 * np.arange(rows), len(pieces)),
        np.repeat(np.arange(len(pieces)), rows),
        pieces,
        np.concatenate(errors),
        np.tile(1e-4 * np.eye(3), (len(q), 1, 1)),
        np.ones(len(q), dtype=bool),
    )


def _fitted(data: Dataset, folds: int) -> Estimator:
    """A process that remembers places, its kernel chosen by a piece of every recording."""
    halves = [[name for name in data.names if name.endswith(half)] for half in ("0", "1")]
    settings = {"points": 400, "tuning_points": 100}
    process = Registry.discover().build(Estimator, "gp", settings)
    process.folds = folds
    process.fit(data.select(halves[0]), data.select(halves[1]), seed=0, report=quiet)
    return process


def test_the_covariance_is_that_of_new_recordings() -> None:
    known = _recordings([f"day{index}" for index in range(10)], 1)
    new = _recordings([f"later{index}" for index in range(20)], 2)
    honest, proud = (_fitted(known, folds) for folds in (5, 0))
    results = [evaluate(new, e.model.predict(new)) for e in (honest, proud)]  # type: ignore[attr-defined]
    assert 0.7 < results[0].consistency ** 0.5 < 1.3
    assert results[1].consistency ** 0.5 > 2.0  # judged by pieces of the recordings learnt from
    assert honest.left_out.recordings == 10
    assert honest.left_out.groups == 5
    assert honest.left_out.after_mm > 1.0
    turns = honest.left_out.by_recording
    assert [turn.name for turn in turns] == sorted(f"day{index}" for index in range(10))
    assert all(turn.labels == 60 for turn in turns)
    assert np.mean([turn.inside_95 for turn in turns]) > 0.85
    assert proud.left_out.groups == 0
    assert proud.left_out.by_recording == ()


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ridge", {"features": "pose", "penalty": 1e-5}),
        ("gp", {"points": 200, "tuning_points": 60}),
    ],
)
def test_baselines_go_through_the_kinematics(name: str, settings: dict[str, float]) -> None:
    """Joint errors that are smooth in the joints are much less so at the tip."""
    rng, schema = np.random.default_rng(5), find_schema("dvrk-psm")
    data = _recordings([f"day{index}" for index in range(8)], 5)
    where = rng.uniform(-1, 1, (len(data), 6))
    q = where * [0.6, 0.6, 50.0, 1.5, 1.2, 1.2] + [0, 0, 150.0, 0, 0, 0]
    wrong = np.sin(where @ rng.normal(0, 0.5, (6, 6))) * [0.003, 0.003, 0.3, 0.03, 0.03, 0.03]
    tip = schema.chain.tip_mm(q)
    errors = schema.chain.tip_mm(q + wrong) - tip + rng.normal(0, 0.02, (len(q), 3))
    states = np.hstack([q * [1, 1, 1e-3, 1, 1, 1], tip])
    left = []
    for known in (schema, replace(schema, chain=None)):
        part = replace(data, errors_mm=errors, schema=known, states=states)
        train, other = part.select(part.names[:12]), part.select(part.names[12:])
        fit = Registry.discover().build(Estimator, name, settings)
        fit.folds = 0
        fit.fit(train, other, seed=0, report=quiet)
        left.append(evaluate(other, fit.model.predict(other)).after.rms_mm)  # type: ignore[attr-defined]
    assert left[0] < 0.7 * left[1]


@pytest.mark.parametrize("names", [("a/0", "a/1", "b/0", "b/1"), ("a/0", "a/1")])
def test_a_recordings_own_offset_is_not_the_nets_to_explain(names: tuple[str, ...]) -> None:
    """In training, recordings may differ by constant joint errors; one recording differs from none.

    Two recordings whose wrists were homed 0.2 rad apart, and a net that says nothing.
    """
    torch = pytest.importorskip("torch")
    data = _recordings(["a", "b"], 1)
    homed = np.where(data.trajectory < 2, -0.1, 0.1)[:, None] * [0, 0, 0, 0, 1, 0]
    errors = data.schema.chain.tip_mm(data.joints + homed) - data.reported_mm
    part = replace(data, errors_mm=errors).select(names)
    units = replace(OutputUnits.of(part), middle_mm=np.zeros(3))
    known = TrainingSet(part, part, lambda d: d.joints, units, [])
    offsets, rows = known.offsets(), torch.arange(len(part))
    said = torch.zeros(len(part), len(units.scale))
    descent, losses = torch.optim.Adam([offsets], lr=0.05), []
    for _ in range(150):
        losses.append(known.loss(rows, said, offsets))
        descent.zero_grad()
        losses[-1].backward()
        descent.step()
    first, last = (float(loss.detach()) - _training_set._SOFT_MM2**0.5 for loss in losses[::149])
    assert first > 0.3
    assert last < 0.5 * first if len(names) == 4 else last == first


def test_whole_recordings_are_kept_for_validation_and_test() -> None:
    split = split_by_trajectory(_recordings(["a", "b", "c", "d"], 1), seed=2)
    parts = [set(part.recordings()) for part in (split.train, split.validation, split.test)]
    assert [len(part) for part in parts] == [2, 1, 1]
    assert len(set.union(*parts)) == 4
    assert split.scored_on == "test"


def test_groups_of_recordings_hold_about_as_many_labels() -> None:
    data = _recordings(["a", "b", "c", "few"], 1)
    data = replace(data, usable=data.usable & ~np.isin(data.trajectory, [6, 7]))
    assert data.recording_groups(4, 10) == [["a/0", "a/1"], ["b/0", "b/1"], ["c/0", "c/1"]]
    assert data.recording_groups(2, 10) == [["a/0", "a/1", "c/0", "c/1"], ["b/0", "b/1"]]
    assert data.select(["a/0", "a/1"]).recording_groups(4, 10) == []


def test_one_recording_promises_nothing_and_validation_is_no_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = tmp_path / "one.parquet", tmp_path / "other.parquet"
    files.write_dataset(one, _recordings(["a"], 1), [], "one")
    files.write_dataset(other, _recordings(["b"], 2), [], "another")
    words = ["train", str(one), "--estimator", "offset", "--out", str(tmp_path / "m.onnx")]
    assert main([*words, "--validation", str(other)]) == 0
    said = capsys.readouterr()
    assert "Nothing is promised: learnt from one recording" in said.out + said.err
    assert "test:" not in said.out
    card = (tmp_path / "m.card.md").read_text()
    assert card.partition("## ")[2].startswith(
        "On a new session of this robot\n\nNothing is promised"
    )
    assert "| recording |" not in card
    assert "Error on the validation trajectories" in card
    assert "test" not in card.partition("## Error")[2]
    assert "test" not in json.loads((tmp_path / "m.card.json").read_text())["data"]
    words += ["--overwrite"]
    assert main([*words, "--test", str(one)]) == 2
    assert "'a/0' is among those to learn from" in capsys.readouterr().err
    assert main([*words, "--test", str(other), "--folds", "1"]) == 2
    assert "--folds 1: expected 2 groups or more" in capsys.readouterr().err


def test_runs_of_one_restart_are_one_recording(tmp_path: Path) -> None:
    names = find_schema("dvrk-psm").names
    head = ["run", "restart", "t_s", "ex", "ey", "ez", *names]
    rows = [
        [run, restart, str(t), "1", "2", "3", *["0.1"] * len(names)]
        for run, restart in (("a", "mon"), ("b", "mon"), ("c", "tue"))
        for t in range(3)
    ]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    data = files.read_labelled(path, find_schema("dvrk-psm"))
    assert data.recordings() == {"mon": ["mon/a", "mon/b"], "tue": ["tue/c"]}


def test_the_card_opens_with_new_sessions_recording_by_recording(tmp_path: Path) -> None:
    data = tmp_path / "data.parquet"
    files.write_dataset(data, _recordings([f"day{index}" for index in range(6)], 1), [], "six")
    words = ["train", str(data), "--estimator", "ridge", "--out", str(tmp_path / "m.onnx")]
    assert main(words) == 0
    first = (tmp_path / "m.card.md").read_text().partition("## ")[2].partition("## ")[0]
    assert "left out in turn" in first
    rows = [line for line in first.splitlines() if line.startswith("| day")]
    assert len(rows) == 4  # one is kept for validation, one for the test
    assert all(line.count("|") == 7 and "%" in line for line in rows)
