"""dataset, train, ablate and estimate, as typed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.host import Dataset
from measure_learning.core import files
from measure_learning.onnx.model import OnnxModel

pytest.importorskip("torch", reason="training needs the extra 'train'")


def test_train_estimate_and_ablate(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "model.onnx", tmp_path / "out.parquet"
    words = ["train", str(data), "-o", str(model), "--estimator", "ridge", "--json"]
    assert main([*words, "--set", "play_widths=4"]) == 0
    scores = json.loads(capsys.readouterr().out)["test"]
    assert scores["rms_change"] < -0.6
    card = (tmp_path / "model.card.md").read_text()
    page = (tmp_path / "model.report.html").read_text()
    assert "On unseen trajectories" in page
    for heading in ("Distribution of the error", "Over time", "How to repeat it"):
        assert f"<h2>{heading}</h2>" in page
    assert "# ridge for raven2-left" in card
    assert "measure" in card
    listed = card.split("## A state")[1].split("## The file")[0]
    assert re.findall(r"`(\w+)`", listed.split("order:")[1]) == list(OnnxModel.load(model).features)
    assert main(["estimate", str(model), "--input", str(data), "--out", str(out)]) == 0
    assert "720 corrected" in capsys.readouterr().out
    from pyarrow import parquet

    table = parquet.read_table(out)
    assert table.column_names[:6] == ["run", "i", "t_s", "ex", "ey", "ez"]
    assert np.isfinite(table["ex"].to_numpy()).all()
    assert main(["ablate", str(data), str(model), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["inputs"]
    cost = {item["name"]: item["permutation_mm"] for item in found}
    assert cost["jpos"] > 10 * abs(cost["type"])
    assert cost["type"] == 0.0


def test_inputs_are_ranked_by_shuffling_and_by_leaving_them_out(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Groups are also fitted without; single fields are the groups' members that vary."""
    model = tmp_path / "model.onnx"
    words = ["train", str(data), "-o", str(model), "--estimator", "ridge", "--set", "features=pose"]
    assert main(words) == 0
    capsys.readouterr()
    assert main(["ablate", str(data), str(model), "--remove", "--json"]) == 0
    groups = {item["name"]: item for item in json.loads(capsys.readouterr().out)["inputs"]}
    assert groups["jpos"]["permutation_mm"] > 0.1
    assert groups["type"]["removal_mm"] == pytest.approx(0.0, abs=1e-6)
    assert all(np.isfinite(item["removed_mm"]) for item in groups.values())
    assert sum(item["features"] for item in groups.values()) == 118
    assert main(["ablate", str(data), str(model), "--single", "--json"]) == 0
    single = {item["name"]: item for item in json.loads(capsys.readouterr().out)["inputs"]}
    assert {"jpos_0", "tau_6", "ori_22"} <= set(single)
    assert "jpos_3" not in single  # void in the message: it never varies
    assert all(item["removed_mm"] is None for item in single.values())


def test_inputs_are_ranked_on_the_models_own_test_trajectories(
    data: Path, small: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it was trained on used to be among them, if it was not split by default."""
    model, other = tmp_path / "model.onnx", tmp_path / "other.parquet"
    words = ["train", str(data), "-o", str(model), "--estimator", "offset", "--json"]
    assert main([*words, "--split-seed", "3", "--test-share", "0.3"]) == 0
    tested = json.loads(capsys.readouterr().out)["test"]["after"]["rms_mm"]
    assert main(["ablate", str(data), str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rms_mm"] == pytest.approx(tested, rel=1e-9)
    files.write_dataset(other, small.rows(np.arange(len(small)) % 2 == 0), [], "every second row")
    assert main(["ablate", str(other), str(model)]) == 2
    assert "give all data sets it was trained on, or a --split-seed" in capsys.readouterr().err
    assert main(["ablate", str(other), str(model), "--split-seed", "0"]) == 0
    assert "may be among the test trajectories" in capsys.readouterr().err


def test_mistakes_are_explained(
    data: Path, small: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = tmp_path / "one.parquet"
    files.write_dataset(one, small.select(small.names[:1]), [], "one trajectory")
    junk = tmp_path / "junk.onnx"
    junk.write_bytes(b"junk")
    cases = [
        (["train", str(one), "-o", str(tmp_path / "m.onnx")], "1 trajectory cannot be split"),
        (["train", str(data), "-o", str(tmp_path / "m.pt")], "must end with .onnx"),
        (
            ["train", str(data), "-o", str(tmp_path / "m.onnx"), "--estimator", "rigde"],
            "did you mean",
        ),
        (
            ["train", str(data), "-o", str(tmp_path / "m.onnx"), "--set", "gruss=2"],
            "unknown setting 'gruss'",
        ),
        (["estimate", str(junk)], "not a usable ONNX file"),
        (["estimate", str(junk), "--out", "x"], "--out needs --input"),
        (["dataset", "-o", "x.parquet"], "give runs, or --simulate-min"),
        (["dataset", str(one), "--robot", "atlas", "-o", "x.parquet"], "no robot schema 'atlas'"),
    ]
    for words, reason in cases:
        assert main(words) == 2, words
        assert reason in capsys.readouterr().err


def test_an_interrupted_training_resumes(data: Path, tmp_path: Path) -> None:
    from measure.host import Registry
    from measure_learning import api

    options = api.TrainOptions("mlp", resume=True, folds=0)
    settings = {"layers": [30], "epochs": 30, "batch": 64}
    out = tmp_path / "m.onnx"

    class Killed(Exception):  # noqa: N818
        pass

    def kill(done: float, what: str) -> None:
        if done > 0.5:
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        from measure_learning.onnx import checkpoint

        patch.setattr(checkpoint, "EVERY_S", 0.0)
        with pytest.raises(Killed):
            api.train([data], out, options, Registry.discover(), kill, settings)
        seen: list[float] = []
        again = api.train(
            [data], out, options, Registry.discover(), lambda d, w: seen.append(d), settings
        )
    assert seen[0] > 0.4
    assert [line.epoch for line in again.curve] == list(range(len(again.curve)))
    straight = api.train(
        [data], tmp_path / "s.onnx", api.TrainOptions("mlp", folds=0), Registry.discover(),
        lambda d, w: None, settings,
    )  # fmt: skip
    assert again.evaluation.after.rms_mm == pytest.approx(
        straight.evaluation.after.rms_mm, rel=1e-4
    )


@pytest.mark.parametrize("apart", [False, True])
def test_inputs_are_ranked_on_the_models_own_test_part(
    small: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], apart: bool
) -> None:
    """They needed a --split-seed, which mixes training into the test."""
    one, two, model = (tmp_path / name for name in ("one.parquet", "two.parquet", "model.onnx"))
    files.write_dataset(one, small.select(small.names[:4]), [], "four trajectories")
    files.write_dataset(two, small.select(small.names[4:]), [], "two more")
    words = [str(one), "--validation", str(two)] if apart else [str(one), str(two)]
    words += ["--out", str(model), "--estimator", "ridge", "--json"]
    assert main(["train", *words]) == 0
    tested = json.loads(capsys.readouterr().out)["test"]["after"]["rms_mm"]
    for order in ([one, two], [two, one]):
        assert main(["ablate", *map(str, order), str(model), "--json"]) == 0
        captured = capsys.readouterr()
        assert json.loads(captured.out)["rms_mm"] == pytest.approx(tested)
        assert "not as in training" not in captured.err
    assert main(["ablate", str(one), str(model)]) == 2
    assert "give all data sets it was trained on" in capsys.readouterr().err
    assert main(["ablate", str(model)]) == 2
    assert "expected data sets, and last the model" in capsys.readouterr().err


def _written(small: Dataset, folder: Path) -> dict[str, str]:
    """Files that fit each other, and some that do not, by name."""
    from measure.robots import RobotLog
    from measure_learning.robots import read_log, write_log
    from measure_learning.simulator import simulate

    run = simulate(12.0, 5, log_hz=50.0)
    names = ("log.csv", "lacking.csv", "poses.csv", "metres.csv", "good.onnx", "other.onnx")
    at = {name: folder / name for name in names}
    write_log(at["log.csv"], RobotLog(small.schema, run.times_s + 1.5, run.states))
    assert len(read_log(at["log.csv"], small.schema).times_s) == len(run.times_s)
    lines = at["log.csv"].read_text().splitlines()
    lacking = lines[0].replace("tau_0", "tau_x").replace("jpos_1", "jpos_x")
    at["lacking.csv"].write_text("\n".join([lacking, *lines[1:]]))
    for name, scale in (("poses.csv", 1.0), ("metres.csv", 1e-3)):
        table = np.column_stack([run.times_s, scale * run.world_from_tip.translation])
        header = "time_s,x_mm,y_mm,z_mm"
        np.savetxt(at[name], table[::5], delimiter=",", header=header, comments="")
    data = folder / "d.parquet"
    files.write_dataset(data, small, [], "the small simulated data set")
    good = at["good.onnx"]
    assert main(["train", str(data), "-o", str(good), "--estimator", "offset"]) == 0
    at["other.onnx"].write_bytes(good.read_bytes().replace(b"raven2-left", b"raven2-lefT", 1))
    return {name: str(path) for name, path in at.items()}


def test_files_that_do_not_fit_are_refused(
    small: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each is one line that names the trouble, and exit code 2."""
    at, out = _written(small, tmp_path), str(tmp_path / "out.csv")
    made = str(tmp_path / "made.parquet")
    cases = [
        (
            ["dataset", at["poses.csv"], "--robot-log", at["lacking.csv"], "-o", made],
            "lacking.csv: lacks 2 of 118 columns: tau_0, jpos_1",
        ),
        (
            ["estimate", at["good.onnx"], "--input", at["lacking.csv"], "--out", out],
            "lacks 2 of 118 columns: tau_0, jpos_1",
        ),
        (
            ["dataset", at["metres.csv"], "--robot-log", at["log.csv"], "-o", made],
            "the measured positions look like metres",
        ),
        (
            ["estimate", at["other.onnx"], "--input", at["log.csv"], "--out", out],
            "other.onnx: damaged, its checksum does not match",
        ),
        (
            ["ablate", str(_other_robot(small, tmp_path)), at["good.onnx"]],
            "trained for robot 'raven2-left', not 'raven2-right'",
        ),
    ]
    capsys.readouterr()
    for words, reason in cases:
        assert main(words) == 2, words
        told = capsys.readouterr().err
        assert reason in told
        assert told.startswith("measure: ")
        assert told.count("\n") == 1


def _other_robot(small: Dataset, tmp_path: Path) -> Path:
    from dataclasses import replace

    path = tmp_path / "right.parquet"
    schema = replace(small.schema, robot="raven2-right")
    files.write_dataset(path, replace(small, schema=schema), [], "another robot")
    return path
