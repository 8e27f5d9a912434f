"""What lies in a rig's folder: recordings, runs, boards of one's own, and versions before."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from measure.api import Registry, read_board
from measure.errors import ConfigError, MeasureError
from measure.results import Provenance, RunWriter
from measure.session import open_session, read_body, session_lacks
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench
from tests.measurements import BODY, CAMERAS, measurement


def write_run(folder):
    made_from = Provenance("/data/s", "a", "calibration.toml", "b", "c", {"name": "precise"}, {})
    with RunWriter(folder, made_from, [BODY], CAMERAS) as writer:
        for index in range(30):
            writer.append(measurement(index, lost=index % 3 == 0))
        writer.finish()


def test_recordings_and_runs_are_listed_and_deleted(still, tmp_path):
    """And nothing else is deleted."""
    assert studio_api.recordings_in(tmp_path) == []
    write_run(tmp_path / "run-1")
    shutil.copytree(still, tmp_path / "session-1")
    (tmp_path / "run-2").mkdir()
    (tmp_path / "run-2" / "run.toml").write_text("[run")
    found = {one.folder.name: one for one in studio_api.recordings_in(tmp_path)}
    run, session, broken = found["run-1"], found["session-1"], found["run-2"]
    assert (run.kind, run.good, run.poses, run.problem) == ("run", 20, 30, "")
    assert run.seconds == pytest.approx(29 / 30)
    assert session.kind == "session"
    assert session.seconds == pytest.approx(11 / 30, abs=0.02)
    assert broken.problem
    cameras, places, good = studio_api.trail_of(run.folder)
    assert len(cameras) == len(CAMERAS)
    assert places.shape == (20, 3)
    assert good.all()
    for name in ("", "..", "none", "../elsewhere"):
        with pytest.raises(ConfigError):
            studio_api.delete_recording(tmp_path, name)
    studio_api.delete_recording(tmp_path, "run-1")
    assert {one.folder.name for one in studio_api.recordings_in(tmp_path)} == {"run-2", "session-1"}


def test_a_recording_takes_the_body_that_was_found_in_it(still, tmp_path):
    """Its balls are then checked and measured as those of any other recording."""
    shutil.copytree(still, session := tmp_path / "session-1")
    file = session / "session.toml"
    text = "".join(f"{one}\n" for one in file.read_text().splitlines() if "body" not in one)
    file.write_text(text)
    assert session_lacks(session) == ["body"]
    body = read_body(still / "body.toml")
    studio_api.name_body(session, body)
    with open_session(session) as opened:
        assert np.allclose(opened.body.centers, body.centers)
        assert opened.streams.keys() == {camera.name for camera in opened.cameras}


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_a_board_of_ones_own_is_written_as_it_was_typed(tmp_path, kind):
    board = studio_api.own_board(kind, 12, 9, 31.5)
    read = read_board(studio_api.write_board(tmp_path, board, "my-board"))
    assert read == board
    assert read.inner_corners == (11, 8)
    assert read.square_mm == 31.5
    assert len(read.points) == 88
    for columns, rows, square_mm in ((2, 9, 30.0), (9, 7, 0.0), (9, 7, np.nan)):
        with pytest.raises(ConfigError, match="3 squares or more"):
            studio_api.own_board(kind, columns, rows, square_mm)
    too_many = studio_api.own_board("charuco", 90, 70, 5.0)
    with pytest.raises(MeasureError):
        studio_api.write_board(tmp_path, too_many, "my-board")
    assert read_board(tmp_path / "my-board.toml") == board


def test_the_version_before_is_one_press_away(tmp_path):
    bench = Bench(tmp_path, Registry.discover(), True, studio_api.CaptureRequest())
    file = tmp_path / "calibration.toml"
    with pytest.raises(ConfigError, match=r"no other version of calibration\.toml"):
        bench.take_back(file)
    file.write_text("second")
    bench.keep(file, b"first", "the calibration")
    assert bench.changed(file) == "the calibration"
    bench.take_back(file)
    assert file.read_text() == "first"
    bench.take_back(file)
    assert file.read_text() == "second"
    assert studio_api.contents_of(tmp_path).calibrations == ()
    bench.keep(file, None, "the calibration")  # Nothing was there before
    with pytest.raises(ConfigError):
        bench.take_back(file)
