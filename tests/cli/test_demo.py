"""`measure demo`: the whole way once."""

from __future__ import annotations

import json
from importlib import import_module

import cv2
import pytest

from measure.cli import main


@pytest.mark.slow
def test_demo_measures_what_it_rendered(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(import_module("measure_learning.demo"), "ROBOT_S", 30.0)
    out = tmp_path / "demo"
    assert main(["demo", "-o", str(out), "--frames", "4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["evaluation"]["frame_sets"] == found["evaluation"]["compared"] == 4
    assert found["evaluation"]["body"]["rms_3d_mm"] < 0.25
    assert found["evaluation"]["rotation"]["rms_3d_deg"] < 0.4
    robot = found["correction"]
    assert robot["before"]["rms_mm"] > 4.0
    assert robot["after"]["rms_mm"] < 0.25 * robot["before"]["rms_mm"]
    for name in ("poses.csv", "run.rrd", "summary.json"):
        assert (out / "run" / name).stat().st_size > 0
    picture = cv2.imread(str(out / "demo.png"))
    assert picture.shape == (720, 1280, 3)

    # Again, with another profile, over the first; a table this time.
    words = ["demo", "-o", str(out), "--frames", "2", "--profile", "paper", "--overwrite"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "2 of 2 poses" in text or "of 2 frame sets" in text
    assert f"measure view {out / 'run'}" in text
    assert "corrected position, mm" in text


def test_demo_overwrites_nothing_but_a_demo(tmp_path, capsys) -> None:
    (tmp_path / "thesis.txt").write_text("important")
    assert main(["demo", "-o", str(tmp_path), "--overwrite"]) == 2
    assert "holds no session/session.toml: give a new folder" in capsys.readouterr().err
    assert main(["demo", "-o", str(tmp_path / "new"), "--frames", "0"]) == 2
    assert "at least one" in capsys.readouterr().err
