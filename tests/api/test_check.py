"""`measure check` on path-traced recordings: silent on good ones, and it finds what is broken."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.api import check
from measure.checking import Level
from measure.cli.app import main
from measure.host import Registry
from measure.results import read_run
from measure.session import Calibration, read_calibration, write_calibration
from tests.calibration.altered import turned


@pytest.fixture(scope="module")
def clutter(renders):
    return renders / "clutter"


def wrong(found):
    return [finding.text for finding in found.findings if finding.level is Level.WRONG]


@pytest.mark.slow
def test_a_good_recording_has_nothing_wrong(clutter):
    found = check(clutter, Registry.discover(), samples=8, clock_samples=0)
    assert wrong(found) == []
    assert found.frame_sets == 3
    assert found.looked_at == 3
    assert found.accuracy.shape == (27, 5)
    assert all(length.agrees for length in (*found.body.distances, *found.body.radii))


@pytest.mark.slow
def test_a_wrong_body_file_is_told(clutter, tmp_path):
    text = (clutter / "body.toml").read_text()
    body = tmp_path / "body.toml"
    body.write_text(text.replace("38.0", "33.0"))
    found = check(clutter, Registry.discover(), body=body, samples=20, clock_samples=0)
    assert any("mm between green and red, the body file says 66.00 mm" in t for t in wrong(found))


@pytest.mark.slow
def test_swapped_calibrations_are_told(clutter, tmp_path, capsys):
    text = (clutter / "calibration.toml").read_text()
    swapped = text.replace('"cam0"', '"x"').replace('"cam1"', '"cam0"').replace('"x"', '"cam1"')
    (tmp_path / "c.toml").write_text(swapped)
    words = ["check", str(clutter), "--calibration", str(tmp_path / "c.toml"), "--json"]
    assert main([*words, "--samples", "6", "--clock-samples", "0"]) == 3
    (finding, *others) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["level"] == "wrong"
    assert "under cam0 are those of cam1, under cam1 are those of cam0;" in finding["text"]
    assert all(finding["topic"] != "calibration" for finding in others)


@pytest.mark.slow
def test_a_mirrored_picture_is_named_and_no_pose_believed(clutter, tmp_path, capsys):
    session, out = tmp_path / "session", tmp_path / "run"
    shutil.copytree(clutter, session)
    for picture in sorted((session / "cam1").glob("*.jpg")):
        over = cv2.flip(cv2.imread(str(picture)), 1)
        cv2.imwrite(str(picture), over, [cv2.IMWRITE_JPEG_QUALITY, 95])
    (text,) = alarms(session, capsys)
    assert text.startswith("the pictures of cam1 are mirrored; with that undone all cameras agree")
    assert main(["run", str(session), "-o", str(out)]) == 0
    assert read_run(out).summary.ok == 0


def still(renders):
    """A recording in which a camera that faces another one sees most balls half hidden."""
    return renders / "still"


def alarms(session, capsys, *more):
    samples = ["--samples", "12", "--clock-samples", "0", "--json"]
    code = main(["check", str(session), *samples, *more])
    found = json.loads(capsys.readouterr().out)["findings"]
    wrong = [f["text"] for f in found if f["level"] == "wrong"]
    assert code == (3 if wrong else 0)
    return wrong


@pytest.mark.slow
def test_a_camera_upside_down_is_named_before_a_second_body(renders, tmp_path, capsys):
    """What it sees elsewhere looks like another body; that is not the first thing to say."""
    cameras = list(read_calibration(still(renders) / "calibration.toml").cameras)
    pose = cameras[1].world_from_camera
    turn = pose.rotate(np.array([0, 0, np.pi]))
    cameras[1] = replace(cameras[1], world_from_camera=pose.perturb([0, 0, 0, *turn]))
    write_calibration(tmp_path / "turned.toml", Calibration(tuple(cameras)))
    first, *_ = alarms(still(renders), capsys, "--calibration", str(tmp_path / "turned.toml"))
    assert first.startswith("cam1 sees balls, but none where the others do (in ")
    assert "another camera's calibration" in first
    assert not any("but none where" in text for text in alarms(still(renders), capsys))


@pytest.mark.slow
def test_a_camera_moved_midway_is_named_with_the_time(renders, tmp_path, capsys):
    session = tmp_path / "still"
    shutil.copytree(still(renders), session)
    for picture in sorted((session / "cam2").glob("*.jpg"))[5:]:
        knocked = turned(0.5, 1)(np.asarray(cv2.imread(str(picture)), np.uint8))
        cv2.imwrite(str(picture), knocked, [cv2.IMWRITE_JPEG_QUALITY, 95])
    (text,) = alarms(session, capsys)
    said = re.match(r"cam2 was moved by (.*) px \((.*) deg\) at about (\S+) s", text)
    assert said is not None, text
    assert float(said[1]) == pytest.approx(12.4, abs=1.5)
    assert float(said[2]) == pytest.approx(0.5, abs=0.1)
    assert float(said[3]) == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_an_occluder_does_not_end_the_check(renders, capsys):
    assert alarms(renders / "occluded", capsys) == []
