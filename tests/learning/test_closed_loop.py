"""From pictures to a correction of a recording never seen, by the command line alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main

pytest.importorskip("torch", reason="training needs the extra 'train'")


@pytest.mark.slow
def test_pictures_to_correction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    run, data = tmp_path / "run", tmp_path / "data.parquet"
    model, out = tmp_path / "model.onnx", tmp_path / "out.csv"
    for session, words in (
        (first, "--seconds 10 --frame-hz 5 --seed 1"),
        (second, "--seconds 9 --frame-hz 0.12 --seed 2"),
    ):
        assert main(["simulate", "-o", str(session), *words.split()]) == 0
    assert main(["run", str(first), "-o", str(run), "--no-recording"]) == 0
    log = str(first / "robot.parquet")
    capsys.readouterr()
    words = ["dataset", str(run), "--robot-log", log, "-o", str(data), "--cut-s", "3.3", "--json"]
    assert main(words) == 0
    (facts,) = json.loads(capsys.readouterr().out)["recordings"]
    assert facts["clock"]["offset_s"] == pytest.approx(1.5, abs=0.06)
    words = ["train", str(data), "-o", str(model), "--estimator", "ridge"]
    assert main([*words, "--set", "features=pose", "--set", "penalty=1"]) == 0
    log = str(second / "robot.parquet")
    assert main(["estimate", str(model), "--input", log, "--out", str(out)]) == 0
    before, after = _rms(second, out)
    assert before > 3.0
    assert after < 0.5 * before


def _rms(session: Path, out: Path) -> tuple[float, float]:
    """RMS of reported and corrected positions against the truth of a session, in mm."""
    from measure_learning.robots import raven_schema, read_log

    log = read_log(session / "robot.parquet", raven_schema())
    truth = np.loadtxt(session / "truth.csv", delimiter=",", skiprows=1)[:, 1:4]
    table = np.genfromtxt(out, delimiter=",", names=True, dtype=None, encoding="utf-8")
    correction = np.stack([table[f"e{axis}"] for axis in "xyz"], axis=1)
    reported = log.schema.position_mm(log.states)
    errors = truth - reported, truth - reported - correction
    before, after = (float(np.sqrt((e**2).sum(axis=1).mean())) for e in errors)
    return before, after
