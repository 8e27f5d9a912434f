"""What a page says of its work: in the words of a page, with the time that is left."""

from __future__ import annotations

import ast
import re
import threading
from html import unescape
from pathlib import Path

import pytest

from measure.api import Registry, board_length, write_measured_board
from measure.errors import ConfigError
from measure_studio.api import CaptureRequest
from measure_studio.page.bench import Bench, Job
from measure_studio.page.measure_page import pose_shown
from measure_studio.page.words import grouped, plain
from tests.measurements import measurement

ROOT = Path(__file__).parents[2]
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
    texts = ["cam1: stamps 7.3 ms uneven", "cam2: stamps 6.9 ms uneven", "cam1: too dark", "a"]
    names = ("cam1", "cam2")
    told = ["cam1: stamps 7.3 ms uneven (alike in cam2)", "cam1: too dark", "a"]
    assert grouped(texts, names) == told
    assert grouped(["cam1: 3 px", "cam1: 4 px"], names) == ["cam1: 3 px", "cam1: 4 px"]
    assert grouped(["ball 1", "ball 2"], ()) == ["ball 1", "ball 2"]


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


def doubts():
    """Every sentence of modules that speak of flags or reasons, with a name where one is put in."""
    for room in ("measure", "plugins"):
        for file in sorted((ROOT / room).rglob("*.py")):
            text = file.read_text("utf-8")
            if not re.search(r"\b(flags?|flagged|reason)\b", text):
                continue
            tree = ast.parse(text)
            apart = {
                id(one.value)
                for one in ast.walk(tree)
                if isinstance(one, ast.Expr | ast.FormattedValue)
            }
            for node in ast.walk(tree):
                if isinstance(node, ast.JoinedStr):
                    apart |= {id(part) for part in node.values}
                    text = "".join(
                        getattr(part, "value", "") if isinstance(part, ast.Constant) else "cam0"
                        for part in node.values
                    )
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    text = node.value
                else:
                    continue
                if id(node) not in apart and len(text.split()) > 2:
                    yield text


def test_every_doubt_stands_below_the_state():
    """Alone, and beside others; a pose that is believed has none."""
    every = list(dict.fromkeys(doubts()))
    assert any("contradict the others" in text for text in every)
    assert any("the fit did not settle" in text for text in every)
    for text in every:
        for beside in ([], every[:1]):
            doubtful = measurement(1)
            for flag in (*beside, text):
                doubtful = doubtful.flagged(flag)
            shown = unescape(pose_shown("tool", doubtful, ""))
            assert 'data-state="DOUBTFUL"' in shown
            for sentence in filter(None, text.split("; ")):
                assert f"<li>{plain(sentence)}</li>" in shown
                assert plain(sentence)
    lost = pose_shown("tool", measurement(1, lost=True), "")
    assert 'data-state="LOST"' in lost
    assert f"<li>{measurement(1, lost=True).reason}</li>" in lost
    good = pose_shown("tool", measurement(1), "")
    assert 'data-state="OK"' in good
    assert "<li>" not in good
