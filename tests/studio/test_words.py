"""What a page says of its work: in the words of a page, with the time that is left."""

from __future__ import annotations

import threading
from html import unescape
from pathlib import Path

import pytest

from measure.api import Finding, Level, Registry, board_length, write_measured_board
from measure.errors import ConfigError
from measure.model import Doubt
from measure_studio.api import CaptureRequest
from measure_studio.page.bench import Bench, Job
from measure_studio.page.layout import findings_shown
from measure_studio.page.measure_page import pose_shown
from measure_studio.page.words import plain
from tests.measurements import measurement
from tests.model.test_doubts import examples

FOLDER = Path("/home/somebody/my rig")


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("--sample green=562,399: no ball-like patch", "no ball-like patch"),
        ("no truth.csv is there; give one with --truth", "no truth.csv is there"),
        ("nothing believed; to find out why: measure check", "nothing believed"),
        ("cam0 sees none of them: `measure check` tells why", "cam0 sees none of them"),
        (f"{FOLDER}/run-1/run.toml: cut off", "run-1/run.toml: cut off"),
        (f"{FOLDER} is full", "my rig is full"),
        ("cam0: 3 pictures - 2 too many; wave on", "cam0: 3 pictures - 2 too many; wave on"),
        ("to measure a body choose one", "to measure a body choose one"),
    ],
)
def test_a_page_names_no_options_commands_or_paths(said, shown):
    assert plain(said, FOLDER) == shown


def test_times_are_those_of_a_clock():
    assert plain("at 1795785159.649 s").startswith("at ")
    assert plain("at 1795785159.649 s").endswith(":39.649 s")
    assert plain("7 of 1795785159 pictures") == "7 of 1795785159 pictures"


def test_what_is_found_of_several_cameras_alike_stands_in_one_line():
    said = [(Level.WEAK, "too dark", "cam1"), (Level.WEAK, "late", ""), (Level.NOTE, "a", "cam1")]
    said += [(Level.WEAK, "too dark", "cam2"), (Level.WRONG, "too dark", "cam3")]
    shown = findings_shown(Finding(level, "clock", *rest) for level, *rest in said)
    lines = ["wrong</b> cam3: too dark", "weak</b> cam1, cam2: too dark", "weak</b> late"]
    places = [shown.index(f"{line}</li>") for line in (*lines, "note</b> cam1: a")]
    assert places == sorted(places)
    assert shown.count("<li") == len(places)


def test_work_says_how_long_it_takes_yet():
    """By one clock, and never that all is done before it is."""
    may_go_on = threading.Event()

    def work(job: Job) -> str:
        may_go_on.wait(10.0)
        return "done"

    job = Job("calibrating", work)
    assert job.text() == "calibrating: elapsed 0:00"
    job.progress(0, 4)
    job.progress(1, 4)
    assert job.text() == "calibrating: elapsed 0:00, about 0:01 left"
    assert job.share == 0.25
    job.progress(4, 4)
    assert job.share is None
    assert job.text() == "calibrating: elapsed 0:00"
    job.progress(80, 4)
    assert job.share is None
    job.title = "writing"
    assert job.text() == "writing: elapsed 0:00"
    may_go_on.set()
    job.wait(10.0)
    assert job.text() == "done"


def test_what_cannot_be_done_yet_waits_its_turn(tmp_path):
    """Unless what goes on fails, or is stopped."""
    bench = Bench(tmp_path, Registry.discover(), True, CaptureRequest())
    done, may_go_on = list[str](), threading.Event()

    def first(job: Job) -> str:
        while not may_go_on.wait(0.01):
            job.progress(1, 2)
        done.append("first")
        return "first"

    def next_one(_: Job) -> str:
        done.append("next")
        return "next"

    def begin_both() -> Job:
        may_go_on.clear()
        bench.begin("first", first)
        bench.begin("next", next_one, waits=True)
        bench.begin("next", next_one, waits=True)
        with pytest.raises(ConfigError, match="first goes on"):
            bench.begin("other", next_one)
        assert [title for title, _ in bench.waiting] == ["next"]
        return bench.job

    job = begin_both()
    may_go_on.set()
    job.wait(10.0)
    bench.job.wait(10.0)
    assert done == ["first", "next"]
    job = begin_both()
    bench.stop()
    job.wait(10.0)
    assert bench.job is job
    assert done == ["first", "next"]


def test_work_that_is_stopped_ends_at_its_next_step():
    """Calibrating as well; but what follows a recording that was stopped early goes on."""

    def work(job: Job) -> str:
        job.stop.wait(10.0)
        job.title = "calibrating"
        job.progress(1, 4)
        while job.runs:
            job.progress(2, 4)
        return "done"

    job = Job("recording", work)
    job.stop.set()
    while job.title == "recording":
        job.wait(0.01)
    assert job.runs
    job.stop.set()
    job.wait(10.0)
    assert job.text() == "stopped: calibrating"


def test_an_error_that_is_over_is_forgotten(tmp_path):
    bench = Bench(tmp_path, Registry.discover(), True, CaptureRequest())

    def work(_: Job) -> str:
        bench.addresses()
        return "never"

    bench.begin("recording", work)
    bench.job.wait(10.0)
    assert "no camera yet" in bench.job.text()
    bench.set_cameras([])
    assert bench.job is None


def test_a_board_is_as_large_as_it_was_measured(tmp_path):
    measured = tmp_path / "measured.toml"
    for name, squares, square_mm in (("charuco_8x5_27", 9, 27.0), ("chessboard_9x6_25", 10, 25.0)):
        assert board_length(name) == (squares, square_mm)
        write_measured_board(name, 1.005 * square_mm, measured)
        assert board_length(measured) == (squares, pytest.approx(1.005 * square_mm))
        with pytest.raises(ConfigError, match="no printer is off by"):
            write_measured_board(name, 1.5 * square_mm, measured)


def test_every_doubt_stands_below_the_state():
    """Alone, and beside others; a pose that is believed has none."""
    for doubt in examples():
        for beside in ([], ["too dark"]):
            shown = unescape(pose_shown("tool", measurement(1).flagged(*beside, doubt), ""))
            assert 'data-state="DOUBTFUL"' in shown
            assert all(f"<li>{plain(sentence)}</li>" in shown for sentence in (*beside, doubt))
    alike = [Doubt("camera-contradicts", camera=name) for name in ("cam1", "cam0")]
    shown = pose_shown("tool", measurement(1).flagged(*alike), "")
    assert "<li>camera cam0, cam1 contradicts the others on every ball" in shown
    lost = pose_shown("tool", measurement(1, lost=True), "")
    assert 'data-state="LOST"' in lost
    assert f"<li>{measurement(1, lost=True).reason}</li>" in lost
    good = pose_shown("tool", measurement(1), "")
    assert 'data-state="OK"' in good
    assert "<li>" not in good
