"""`measure check` says which camera handed out a picture twice, whatever it was recorded to."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from measure.cli.app import main
from measure.session import open_session
from tests.session.conftest import Recording, jpeg, write_recording
from tests.session.videos import write_video

FRAMES = 8


def said(path: Path, capsys, clock_samples: int = 0) -> dict[str, tuple[str, str]]:
    """Level and text of what is said about repeats, by camera."""
    given = ["--samples", "8", "--clock-samples", str(clock_samples), "--json"]
    code = main(["check", str(path), *given])
    found = json.loads(capsys.readouterr().out)["findings"]
    assert code == (3 if any(f["level"] == "wrong" for f in found) else 0)
    lines = [f for f in found if "repeat the one before" in f["text"]]
    assert all(f["topic"] == "frames" for f in lines)
    return {f["text"].split(":")[0]: (f["level"], f["text"]) for f in lines}


def freeze(recording: Recording, camera: str, frames: list[int]) -> None:
    for k in frames:
        (recording.path / camera / f"{k:06d}.jpg").write_bytes(jpeg(20 * (frames[0] - 1)))


def test_a_recording_without_repeats_is_left_alone(tmp_path, capsys):
    assert said(write_recording(tmp_path / "rec", frames=FRAMES).path, capsys) == {}


def test_duplicate_files_are_counted_in_the_whole_recording(tmp_path, capsys):
    recording = write_recording(tmp_path / "rec", frames=FRAMES)
    freeze(recording, "cam1", [3, 4])
    freeze(recording, "cam2", [1, 2, 3, 4, 5, 6, 7])
    found = said(recording.path, capsys)
    assert set(found) == {"cam1", "cam2"}
    assert found["cam1"][0] == "weak"
    assert "2 of 7 pictures" in found["cam1"][1]
    assert "at most 2 in a row, from frame 3 at 0.300 s" in found["cam1"][1]
    assert found["cam2"][0] == "wrong"
    assert "7 of 7 pictures" in found["cam2"][1]


def test_pictures_of_one_size_that_differ_are_no_repeats(tmp_path):
    recording = write_recording(tmp_path / "rec", frames=3)
    for k in range(3):
        data = jpeg(100) + bytes([k])  # what stands behind a JPEG's end is not decoded
        (recording.path / "cam0" / f"{k:06d}.jpg").write_bytes(data)
    with open_session(recording.path) as session:
        assert session.streams["cam0"].repeated().tolist() == []


@pytest.mark.parametrize("repeated", [[], [4, 5]])
def test_duplicates_of_a_video_are_found_by_decoding(tmp_path, capsys, repeated):
    recording = write_recording(tmp_path / "rec", frames=FRAMES)
    shows = [2 * (3 if k in repeated else k) for k in range(FRAMES)]
    write_video(recording.path / "cam0.mp4", "libx264", frames=FRAMES, shows=shows)
    recording.replace("session.toml", 'images = "cam0/*.jpg"', 'video = "cam0.mp4"')
    found = said(recording.path, capsys)
    assert set(found) == ({"cam0"} if repeated else set())
    if repeated:
        assert "at most 2 in a row, from frame 4" in found["cam0"][1]
