"""A robot that is not RAVEN, its base, tool and clock unknown, by the command line alone."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from benchmarks import any_robot
from measure.cli import main
from measure_learning.robots import find_schema

TRAIN = "train first.parquet --out model.onnx"
LOG = "--robot-log first/robot.csv --robot ur5e"


@pytest.mark.slow
def test_pictures_to_correction_of_a_ur5e(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arm = any_robot.make_arm(gear_deg=0.4)
    any_robot.render(Path("first"), arm, 18.0, 2.0, 1, slow=2.5)
    any_robot.render(Path("second"), arm, 8.0, 0.1, 2, slow=2.5)

    def do(words: str, code: int = 0) -> str:
        assert main(shlex.split(words)) == code
        told = capsys.readouterr()
        return f"{told.out}{'' if '--json' in words else told.err}"

    do("run first --out first-run --no-recording")
    # Without a frame its labels are none.
    assert "measure register" in do(f"dataset first-run {LOG} --out wrong.parquet", 2)
    found = json.loads(do(f"register first-run {LOG} -o frame.toml --json"))
    tool = found["flange_from_body"]["translation_mm"]
    assert tool == pytest.approx(any_robot.FLANGE_FROM_BODY.translation, abs=3.0)
    assert found["clock_offset_s"] == pytest.approx(any_robot.CLOCK_OFFSET_S, abs=0.01)
    told = do(f"dataset first-run {LOG} --frame frame.toml --out first.parquet --cut-s 6 --json")
    (facts,) = json.loads(told)["recordings"]
    assert facts["usable"] == 36
    # So few labels teach links nothing, and one recording promises nothing.
    assert "at least 26 are needed" in do(f"{TRAIN} --estimator kinematic", 2)
    assert "Nothing is promised" in do(f"{TRAIN} --estimator ridge --set features=pose")
    do("estimate model.onnx --input second/robot.csv --out out.csv")
    assert len(Path("out.csv").read_text().splitlines()) == 1251
    reported, corrected = any_robot.errors(tmp_path)
    assert 0.3 < reported < 3.0
    assert corrected < 6.0


def test_the_arm_of_the_benchmark_is_a_ur5e_that_errs() -> None:
    """The truth differs from the published arm by about what links and gears were drawn with."""
    arm, published = any_robot.make_arm(), find_schema("ur5e").chain
    assert published is not None
    q = np.deg2rad(any_robot.HOME_DEG)[None]
    off = np.linalg.norm(arm.pose(q).translation - published.tip_mm(q))
    assert 0.3 < off < 10
