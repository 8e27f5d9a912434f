"""What commands say, and where."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from measure.cli import console
from measure.host import Distribution


@dataclass
class Clock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


def test_without_a_terminal_progress_is_a_line_every_few_seconds():
    out, clock = io.StringIO(), Clock()
    report = console.ProgressLines("measuring", "frame sets", out, clock)
    for done in range(1, 121):
        clock.now = 0.1 * done
        report(done, 240)
    assert out.getvalue().splitlines() == [
        "measuring: 50/240 frame sets, elapsed 0:05, about 0:19 left",
        "measuring: 100/240 frame sets, elapsed 0:10, about 0:14 left",
    ]


def test_a_total_that_is_passed_promises_nothing_more():
    out, clock = io.StringIO(), Clock()
    report = console.ProgressLines("looking", "frame sets", out, clock)
    report(0, 24)
    for clock.now, done, total in ((6.0, 12, 24), (12.0, 24, 24), (18.0, 80, 24), (80.0, 90, None)):
        report(done, total)
    assert out.getvalue().splitlines() == [
        "looking: 12/24 frame sets, elapsed 0:06, about 0:06 left",
        "looking: 24/24 frame sets, elapsed 0:12",
        "looking: 80 frame sets, elapsed 0:18",
        "looking: 90 frame sets, elapsed 1:20",
    ]


def test_without_a_total_there_is_no_promise():
    out, clock = io.StringIO(), Clock()
    report = console.ProgressLines("reading", "rows", out, clock)
    report(0, None)
    clock.now = 5.0
    report(40, None)
    assert out.getvalue() == "reading: 40 rows, elapsed 0:05\n"


def test_a_slow_start_does_not_count_as_the_pace():
    out, clock = io.StringIO(), Clock()
    report = console.ProgressLines("rendering", "pictures", out, clock)
    clock.now = 60.0
    report(1, 101)
    clock.now = 65.0
    report(51, 101)
    assert out.getvalue().splitlines() == [
        "rendering: 1/101 pictures, elapsed 1:00",
        "rendering: 51/101 pictures, elapsed 1:05, about 0:05 left",
    ]


def test_short_work_is_silent_without_a_terminal():
    out = io.StringIO()
    with console.progress("measuring", stream=out) as report:
        report(1, 2)
        report(2, 2)
    assert out.getvalue() == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_there_is_a_bar_that_leaves_nothing_behind():
    out = Terminal()
    with console.progress("measuring", stream=out) as report:
        report(3, 12)
    assert "measuring" in out.getvalue()
    assert "3/12 frame sets, elapsed 0:00" in out.getvalue()
    assert "\x1b[2K" in out.getvalue()


def test_json_knows_arrays_paths_records_and_gaps(capsys):
    console.print_json(
        {
            "array": np.array([1.5, np.nan]),
            "number": np.float64(2.0),
            "count": np.int64(3),
            "flag": np.bool_(True),
            "path": Path("a") / "b",
            "record": Distribution("acme", "1.0"),
            "gap": float("inf"),
            "tuple": (1, None, "ä"),
            3: "key",
        }
    )
    out = capsys.readouterr().out
    assert json.loads(out) == {
        "array": [1.5, None],
        "number": 2.0,
        "count": 3,
        "flag": True,
        "path": "a/b",
        "record": {"name": "acme", "version": "1.0"},
        "gap": None,
        "tuple": [1, None, "ä"],
        "3": "key",
    }
    assert "ä" in out


def test_what_json_does_not_know_is_refused():
    with pytest.raises(TypeError, match="object has no form in JSON"):
        console.print_json({"x": object()})


def test_text_is_there_at_once_also_in_a_pipe(monkeypatch):
    """As the address of a viewer that goes on until it is ended."""
    pipe = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(pipe))
    console.print_text("http://127.0.0.1")
    assert pipe.getvalue() == b"http://127.0.0.1\n"


def test_tables_align_numbers_and_leave_gaps_empty(capsys):
    console.print_table(
        ("name", "x_mm", "count"), [("a[b]", 0.123456, 3), ("b", None, 12)], title="T"
    )
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "T",
        " name    x_mm  count",
        " a[b]  0.1235      3",
        " b                12",
    ]


def test_long_cells_are_folded_never_cut(capsys):
    text = "word " * 60
    console.print_table(("a", "b"), [("x", text)])
    assert capsys.readouterr().out.count("word") == 60


def test_an_empty_table_is_its_heading(capsys):
    console.print_table(("a", "b"), [])
    assert capsys.readouterr().out.split() == ["a", "b"]


def test_a_line_is_written_at_one_go(monkeypatch):
    """Two threads' lines ran into each other where the line's end was a write of its own."""
    written = []

    class Stream(io.StringIO):
        def write(self, text):
            written.append(text)
            return len(text)

    monkeypatch.setattr("sys.stderr", Stream())
    console.note("cam1 is away")
    assert written == ["cam1 is away\n"]
