"""dataset, train, ablate, sweep and estimate, as typed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.host import Dataset
from measure.learning import files

pytest.importorskip("torch", reason="training needs the extra 'train'")


@pytest.fixture(scope="module")
def data(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "data.parquet"
    files.write_dataset(path, small, [], "the small simulated data set")
    return path


def test_train_estimate_and_ablate(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "model.onnx", tmp_path / "out.parquet"
    assert main(["train", str(data), "-o", str(model), "--estimator", "ridge", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)["test"]
    assert scores["rms_change"] < -0.6
    card = (tmp_path / "model.card.md").read_text()
    assert "On unseen trajectories" in (tmp_path / "model.report.html").read_text()
    assert "# ridge for raven2-left" in card
    assert "measure" in card
    assert main(["estimate", str(model), "--input", str(data), "--output", str(out)]) == 0
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
        (["estimate", str(junk), "--output", "x"], "--output needs --input"),
        (["dataset", "-o", "x.parquet"], "give runs, or --simulate-min"),
        (["dataset", str(one), "--robot", "atlas", "-o", "x.parquet"], "no robot schema 'atlas'"),
    ]
    for words, reason in cases:
        assert main(words) == 2, words
        assert reason in capsys.readouterr().err


def test_an_interrupted_training_resumes(data: Path, tmp_path: Path) -> None:
    from measure import api
    from measure.host import Registry

    options = api.TrainOptions("mlp", {"layers": [30], "epochs": 30, "batch": 64}, resume=True)
    out = tmp_path / "m.onnx"

    class Killed(Exception):  # noqa: N818
        pass

    def kill(done: float, what: str) -> None:
        if done > 0.5:
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        from measure_plugins.estimators import _checkpoint

        patch.setattr(_checkpoint, "EVERY_S", 0.0)
        with pytest.raises(Killed):
            api.train([data], out, options, Registry.discover(), kill)
        seen: list[float] = []
        again = api.train([data], out, options, Registry.discover(), lambda d, w: seen.append(d))
    assert seen[0] > 0.4
    assert [line.epoch for line in again.curve] == list(range(len(again.curve)))
    straight = api.train(
        [data], tmp_path / "s.onnx", api.TrainOptions("mlp", options.settings), Registry.discover(),
        lambda d, w: None,
    )  # fmt: skip
    assert again.evaluation.after.rms_mm == pytest.approx(
        straight.evaluation.after.rms_mm, rel=1e-4
    )


SPACE = """
[penalty]
low = 1e-6
high = 1e-1
log = true
[features]
choices = ["pose", "play"]
"""


@pytest.mark.slow
def test_a_killed_worker_loses_no_trial(data: Path, tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    space, journal = tmp_path / "space.toml", tmp_path / "journal.log"
    space.write_text(SPACE)
    words = [sys.executable, "-m", "measure.cli", "sweep", str(data), str(space)]
    words += ["--journal", str(journal), "--estimator", "ridge", "--trials", "8", "--json"]
    with (tmp_path / "out.json").open("w") as out:
        one = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        two = subprocess.Popen(words, stdout=out, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while not (journal.exists() and journal.stat().st_size > 2000):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(one.pid, signal.SIGKILL)
        one.wait()
        assert two.wait(timeout=120) == 0
    state = json.loads((tmp_path / "out.json").read_text())
    assert state["finished"] >= 8
    assert state["running"] == 0
    scores = [score for score, _ in state["best"]]
    assert len(scores) >= 8
    assert scores == sorted(scores)
    assert all(0 < score < 100 for score in scores)
