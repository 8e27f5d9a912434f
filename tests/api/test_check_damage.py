"""`measure check` names pictures that are damaged and decode all the same."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.cli.app import main
from tests.session.conftest import write_recording
from tests.session.videos import write_video


def _rough(seed: int) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def _damaged(data: bytes) -> bytes:
    return data[: len(data) // 2] + data[len(data) // 2 + 400 :]


@pytest.fixture
def said(capsys):
    def check(path: Path) -> list[str]:
        given = ("--samples", "2", "--clock-samples", "0", "--json")
        code = main(["check", str(path), *given])
        found = json.loads(capsys.readouterr().out)["findings"]
        assert code == (3 if any(f["level"] == "wrong" for f in found) else 0)
        return [f["text"] for f in found if "damaged" in f["text"] and f["level"] == "wrong"]

    return check


def test_damaged_pictures_are_named_wherever_they_are(tmp_path, said) -> None:
    recording = write_recording(tmp_path / "rec", frames=8)
    for k in range(8):
        (recording.path / "cam1" / f"{k:06d}.jpg").write_bytes(_rough(k))
    assert said(recording.path) == []
    for k in (3, 5):
        (recording.path / "cam1" / f"{k:06d}.jpg").write_bytes(_damaged(_rough(k)))
    (line,) = said(recording.path)
    assert line.startswith("cam1: 2 of 8 pictures are damaged (frames 3, 5): ")


def test_videos_of_other_codecs_are_passed_over(tmp_path, said) -> None:
    """What they hold is checked as it is decoded."""
    recording = write_recording(tmp_path / "rec", frames=8)
    for camera, codec in (("cam1", "libx264"), ("cam2", "mjpeg")):
        write_video(recording.path / f"{camera}.mp4", codec, frames=8)
        recording.replace("session.toml", f'images = "{camera}/*.jpg"', f'video = "{camera}.mp4"')
    assert said(recording.path) == []


def test_a_session_without_body_and_calibration_is_checked_as_far_as_it_can_be(tmp_path, capsys):
    """As `measure record` leaves it."""
    recording = write_recording(tmp_path / "rec", frames=8)
    for line in ('body = "body.toml"\n', 'calibration = "calibration.toml"\n'):
        recording.replace("session.toml", line, "")
    (recording.path / "cam1" / "000003.jpg").write_bytes(_damaged(_rough(3)))
    (recording.path / "cam0" / "000002.jpg").unlink()
    assert main(["check", str(recording.path), "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    texts = [f["text"] for f in found["findings"]]
    assert found["frame_sets"] == 8
    assert "cam1: 1 of 8 pictures are damaged (frame 3)" in " ".join(texts)
    assert "cam0': 1 of 8 frames have no image" in " ".join(texts)
    assert texts[-1].endswith("that needs --body FILE and --calibration FILE")
    body = ["--body", str(recording.path / "body.toml")]
    assert main(["check", str(recording.path), *body]) == 3
    assert "that needs --calibration FILE" in capsys.readouterr().out
