"""A session folder that grows: whatever ends it, all before that can be measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.errors import CaptureError, SessionError
from measure.model import Image
from measure.session import open_session, write_body, write_calibration
from measure.session.calibration_file import Calibration
from measure_studio.capture import Recorder
from tests.session.conftest import jpeg

NAMES = ("cam0", "cam1")


@pytest.fixture
def calibration(rig):
    return Calibration(rig[:2])


def pictures(count=3, size_wh=(1280, 720)):
    data = jpeg(90, size_wh)
    for k in range(count):
        for name in NAMES:
            yield Image(name, k, 1.7e9 + k / 30, lambda: None, data + bytes([k]))


def recorded(folder, body, calibration, count=3):
    with Recorder(
        folder, dict.fromkeys(NAMES, "http://x"), [body] if body else [], calibration
    ) as recorder:
        for image in pictures(count):
            recorder.add(image)
    return folder


def test_it_is_a_session(tmp_path, paper_body, calibration):
    folder = recorded(tmp_path / "new" / "session", paper_body, calibration)
    with open_session(folder) as session:
        assert session.name == "session"
        assert session.notes == ()
        assert list(session.streams) == list(NAMES)
        for stream in session.streams.values():
            np.testing.assert_allclose(stream.times_s, 1.7e9 + np.arange(3) / 30, atol=1e-6)
    assert (folder / "cam1" / "000002.jpg").read_bytes() == next(
        i.encoded for i in pictures() if (i.camera, i.frame) == ("cam1", 2)
    )


def test_it_can_be_measured_while_it_is_written(tmp_path, paper_body, calibration):
    """As after a kill: nothing was closed."""
    recorder = Recorder(tmp_path / "s", dict.fromkeys(NAMES, "x"), [paper_body], calibration)
    for image in pictures():
        recorder.add(image)
    with open_session(tmp_path / "s") as session:
        assert [len(stream) for stream in session.streams.values()] == [3, 3]
    recorder.close()


def test_a_kill_between_stamp_and_picture_leaves_a_missing_frame(tmp_path, paper_body, calibration):
    folder = recorded(tmp_path / "s", paper_body, calibration)
    last = folder / "cam0" / "000002.jpg"
    last.rename(last.with_suffix(".part"))
    with open_session(folder) as session:
        assert "cam0': 1 of 3 frames have no image" in session.notes[0]


def test_body_and_calibration_may_come_later(tmp_path, paper_body, calibration):
    folder = recorded(tmp_path / "s", None, Calibration(()))
    with pytest.raises(SessionError, match="names no body"):
        open_session(folder)
    write_body(tmp_path / "b.toml", paper_body)
    write_calibration(tmp_path / "c.toml", calibration)
    with open_session(folder, tmp_path / "c.toml", tmp_path / "b.toml") as session:
        assert len(session.cameras) == 2


def test_what_is_no_jpeg_becomes_one_that_hardly_differs(tmp_path, rng):
    smooth = np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((20, 20, 1))).astype(np.uint8)
    with Recorder(tmp_path / "s", {"cam0": "rtsp://x"}) as recorder:
        recorder.add(Image("cam0", 0, 0.0, lambda: smooth))
    from measure.session import read_picture

    off = read_picture(tmp_path / "s" / "cam0" / "000000.jpg").astype(float) - smooth
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_pictures_that_come_after_the_end_leave_nothing(tmp_path, paper_body, calibration):
    folder = tmp_path / "s"
    recorder = Recorder(folder, dict.fromkeys(NAMES, "x"), [paper_body], calibration)
    recorder.close()
    for image in pictures():
        recorder.add(image)
    assert list((folder / "cam0").iterdir()) == []


def test_a_folder_that_vanishes_is_told_in_one_line(tmp_path):
    import shutil

    recorder = Recorder(tmp_path / "s", dict.fromkeys(NAMES, "x"))
    shutil.rmtree(tmp_path / "s" / "cam0")
    with pytest.raises(CaptureError, match=r"be written: No such file.*; nothing was recorded"):
        recorder.add(next(pictures()))
    recorder.close()
    (tmp_path / "file").touch()
    with pytest.raises(CaptureError, match=r"cannot be written: .*; nothing was recorded"):
        Recorder(tmp_path / "file" / "s", dict.fromkeys(NAMES, "x"))


@pytest.mark.parametrize(
    "names",
    [("a/b",), ("..",), ("",), ("a\\b",), ("Cam", "cam"), ("session.toml",), ("a", "a.csv")],
)
def test_names_that_cannot_be_folders_are_refused_first(tmp_path, names):
    with pytest.raises(CaptureError, match="name"):
        Recorder(tmp_path / "s", dict.fromkeys(names, "x"))
    assert not (tmp_path / "s").exists()


def test_a_name_that_looks_like_a_pattern_is_found_again(tmp_path, paper_body, rig):
    names = ("cam[0]", "c*")
    cameras = tuple(replace(c, name=name) for c, name in zip(rig, names, strict=False))
    with Recorder(
        tmp_path / "s", dict.fromkeys(names, "x"), [paper_body], Calibration(cameras)
    ) as recorder:
        for image in pictures():
            recorder.add(replace(image, camera=names[NAMES.index(image.camera)]))
    with open_session(tmp_path / "s") as session:
        assert {name: len(stream) for name, stream in session.streams.items()} == {
            "cam[0]": 3,
            "c*": 3,
        }


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_full_disk_is_reported_though_closing_fails_too(tmp_path):
    recorder = Recorder(tmp_path / "s", dict.fromkeys(NAMES, "x"))
    recorder._stamps["cam0"].close()
    full = Path("/dev/full").open("w", encoding="utf-8", buffering=1)  # noqa: SIM115 it is closed
    recorder._stamps["cam0"] = full
    told = "No space left on device; nothing was recorded"
    with pytest.raises(CaptureError, match=told), recorder:
        recorder.add(next(pictures()))


def test_the_second_of_two_that_begin_at_once_writes_nothing(tmp_path, paper_body, calibration):
    """Both have found the folder free."""
    folder = recorded(tmp_path / "s", paper_body, calibration)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(CaptureError, match="cam0: cannot be written: File exists"):
        Recorder(folder, dict.fromkeys(NAMES, "other"))
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
