"""Ball centres marked by hand, compared with what was detected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.errors import RunError
from measure.results import Run, RunWriter, evaluate, read_marks, read_run
from measure.session import read_trajectory
from tests.results.conftest import (
    BODY,
    CAMERAS,
    PERIOD_S,
    made_from,
    measurement,
    write_truth,
    written,
)
from tests.session.conftest import write_recording

COUNT = 60


def test_detection_against_marks_by_hand(tmp_path: Path) -> None:
    lines = ["camera,frame,ball,u_px,v_px"]
    for i in range(0, COUNT, 10):
        for view in measurement(i).views:
            u, v = view.detection.center_px + np.array([0.3, 0.4])
            lines.append(f"{view.camera},{i},{view.ball},{u:.9f},{v:.9f}")
    (tmp_path / "marks.csv").write_text("\n".join(lines) + "\n")
    run = written(tmp_path / "run", map(measurement, range(COUNT)))
    truth = read_trajectory(write_truth(tmp_path / "truth.csv", COUNT * PERIOD_S))
    marks = read_marks(tmp_path / "marks.csv", run)
    alone = evaluate(run, truth, marks=marks).detection
    assert alone.pixels.count == 54
    assert alone.pixels.rms_2d_px == pytest.approx(0.5, abs=1e-6)
    assert alone.ball.count == 18
    assert 0.05 < alone.ball.rms_3d_mm < 0.35
    (tmp_path / "bad.csv").write_text("camera,frame,u_px,v_px\ncam0,1,2,3\n")
    with pytest.raises(RunError, match=r"bad\.csv:1: the header lacks ball"):
        read_marks(tmp_path / "bad.csv", run)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("cam9,1,green,2,3", "no camera of .* is called 'cam9'; there is cam0, cam1, cam2"),
        ("cam0,1,grean,2,3", "no ball of .* is called 'grean'; there is green, yellow, red"),
        ("cam0,5,green,2,3", "has no frame 5 of cam0"),
        ("cam0,0.5,green,2,3", "has no frame 0.5 of cam0"),
        ("cam0,nan,green,2,3", "has no frame nan of cam0"),
        ("cam0,1,green,nan,3", r"the mark is at \(nan, 3\) px"),
        ("cam0,1,green,2,inf", r"the mark is at \(2, inf\) px"),
        ("cam0,0,green,2,4", "frame 0 of cam0 marks 'green' twice"),
    ],
)
def test_marks_of_what_is_not_in_the_run_are_refused(tmp_path: Path, row: str, said: str) -> None:
    run = written(tmp_path / "run", map(measurement, range(2)))
    path = tmp_path / "marks.csv"
    path.write_text("camera,frame,ball,u_px,v_px\n, ,,,\ncam0,0,green,2,3\n" + row)
    with pytest.raises(RunError, match=rf"marks\.csv:4: .*{said}"):
        read_marks(path, run)
    path.write_text("camera,frame,ball,u_px,v_px\n, ,,,\ncam0,0,green,2,3\n")
    assert list(read_marks(path, run)) == [("cam0", 0, "green")]


def test_half_a_detection_is_compared_with_no_mark(tmp_path: Path) -> None:
    half = np.array([0, np.nan])
    run = written(tmp_path / "run", [measurement(i, pixel_error=half) for i in range(2)])
    truth = read_trajectory(write_truth(tmp_path / "truth.csv", 2 * PERIOD_S))
    (tmp_path / "marks.csv").write_text("camera,frame,ball,u_px,v_px\ncam0,1,green,2,3\n")
    found = evaluate(run, truth, marks=read_marks(tmp_path / "marks.csv", run)).detection
    assert found.pixels is None


def test_a_frame_that_may_have_been_skipped_may_be_marked(tmp_path: Path) -> None:
    run = written(tmp_path / "run", [measurement(i, lost=i > 1) for i in range(4)])
    (tmp_path / "marks.csv").write_text("camera,frame,ball,u_px,v_px\ncam0,3,green,2,3\n")
    assert read_marks(tmp_path / "marks.csv", run)


@pytest.fixture
def stopped(tmp_path: Path) -> Run:
    """A run of a recording with six frames, of which it measured two."""
    recording = write_recording(tmp_path / "rec", frames=6)
    made = replace(made_from(), session=str(recording.path / "session.toml"))
    with RunWriter(tmp_path / "run", made, [BODY], CAMERAS) as writer:
        writer.append(measurement(0))
        writer.append(measurement(1))
    return read_run(tmp_path / "run")


def test_frames_beyond_the_end_of_a_stopped_run_may_be_marked(stopped: Run, tmp_path: Path) -> None:
    path = tmp_path / "marks.csv"
    rows = [f"cam{c},{f},green,2,3" for c in (0, 1) for f in (0, 1, 5)]
    path.write_text("\n".join(["camera,frame,ball,u_px,v_px", *rows]))
    marks = read_marks(path, stopped)
    truth = read_trajectory(write_truth(tmp_path / "truth.csv", 2 * PERIOD_S))
    found = evaluate(stopped, truth, marks=marks)
    assert "2 of 6 marks are of frames that the run has not: passed over" in found.notes
    assert found.detection.pixels.count == 4
    path.write_text("camera,frame,ball,u_px,v_px\ncam0,6,green,2,3\n")
    with pytest.raises(RunError, match="has no frame 6 of cam0"):
        read_marks(path, stopped)
    (tmp_path / "rec" / "session.toml").unlink()
    assert len(read_marks(path, read_run(stopped.path))) == 1, "nobody can tell any more"


def test_no_frame_beyond_the_end_of_a_whole_run_may_be_marked(stopped: Run, tmp_path) -> None:
    (tmp_path / "marks.csv").write_text("camera,frame,ball,u_px,v_px\ncam0,5,green,2,3\n")
    assert read_marks(tmp_path / "marks.csv", stopped)
    with pytest.raises(RunError, match="has no frame 5 of cam0"):
        read_marks(tmp_path / "marks.csv", replace(stopped, finished=True))
