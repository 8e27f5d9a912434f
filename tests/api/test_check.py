"""`measure check` on the shared recordings: silent on good ones, and it finds what is broken."""

from __future__ import annotations

import json
import shutil

import pytest

from measure.api import check
from measure.cli.app import main
from measure.host import Registry
from measure.measuring.checks import Level


@pytest.fixture(scope="module")
def clutter(shared):
    folder = shared / "renders" / "clutter"
    if not folder.is_dir():
        pytest.skip("no rendered sessions in ../shared")
    return folder


def wrong(found):
    return [finding.text for finding in found.findings if finding.level is Level.WRONG]


@pytest.mark.slow
def test_a_good_recording_has_nothing_wrong(clutter):
    found = check(clutter, Registry.discover(), samples=8, clock_samples=0)
    assert wrong(found) == []
    assert found.frame_sets == 20
    assert found.looked_at == 8
    assert found.accuracy.shape == (27, 5)
    assert all(length.agrees for length in (*found.body.distances, *found.body.radii))


@pytest.mark.slow
def test_a_wrong_body_file_is_told(clutter, tmp_path):
    text = (clutter / "body.toml").read_text()
    body = tmp_path / "body.toml"
    body.write_text(text.replace("38.0", "33.0"))
    found = check(clutter, Registry.discover(), body=body, samples=16, clock_samples=0)
    assert any("1.15" in line and "times as far apart" in line for line in wrong(found))


@pytest.mark.slow
def test_swapped_calibrations_are_told(clutter, tmp_path, capsys):
    text = (clutter / "calibration.toml").read_text()
    swapped = text.replace('"cam0"', '"x"').replace('"cam1"', '"cam0"').replace('"x"', '"cam1"')
    (tmp_path / "c.toml").write_text(swapped)
    code = main(
        [
            "check",
            str(clutter),
            "--calibration",
            str(tmp_path / "c.toml"),
            "--samples",
            "6",
            "--clock-samples",
            "0",
            "--json",
        ]
    )
    assert code == 0
    found = json.loads(capsys.readouterr().out)
    assert "wrong" in [finding["level"] for finding in found["findings"]]


def test_a_broken_session_is_one_line(tmp_path, clutter, capsys):
    shutil.copy(clutter / "session.toml", tmp_path)
    assert main(["check", str(tmp_path)]) == 2
    assert "body.toml" in capsys.readouterr().err
