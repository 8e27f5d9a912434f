"""Output of commands: progress on stderr, tables or one JSON object on stdout."""

from __future__ import annotations

import json as json_library
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TextIO

from cyclopts import Parameter
from pydantic_core import to_jsonable_python
from rich.console import Console
from rich.table import Table

from measure.processes import Progress, ProgressClock

JsonFlag = Annotated[bool, Parameter(name="--json", help="Print one JSON object and nothing else.")]
"""Type of every command's `json` option."""
OutFile = Annotated[Path, Parameter(name=("--out", "-o"))]
Overwrite = Annotated[bool, Parameter(help="Replace what is there.")]
CalibrationFormat = Annotated[str, Parameter(name="--format")]
"""Types of options that several commands have."""

UNBELIEVABLE = 3
"""Exit code of `check`, `calibrate` and `accept` where they find something wrong."""
_LINE_EVERY_S = 5.0


def print_json(value: Any) -> None:
    """Print one JSON object; arrays become lists, NaN becomes null, dataclasses objects."""
    plain = to_jsonable_python(value, inf_nan_mode="null", fallback=_known_to_json)
    ascii_only = str(sys.stdout.encoding).lower() != "utf-8"
    print(json_library.dumps(plain, allow_nan=False, ensure_ascii=ascii_only, indent=2))


def print_text(text: str) -> None:
    """Print plain text at once, never wrapped, coloured or re-interpreted."""
    print(text, flush=True)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print a table; numbers are aligned right.

    Args:
        columns: headings, with units where there are any ("x_mm").
        rows: cells; floats are shown with four significant digits, None as an empty cell.
        title: a line above the table.
    """
    rows = [list(row) for row in rows]
    table = Table(title=title or None, title_justify="left", title_style="bold", box=None)
    for index, heading in enumerate(columns):
        numeric = all(isinstance(row[index], int | float | None) for row in rows)
        table.add_column(heading, justify="right" if numeric and rows else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(_cell, row))
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=120)
    console.print(table)


def note(text: str) -> None:
    """Print a line on stderr, at once and at one go: several threads may."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def shares(report: Progress) -> Callable[[float, str], None]:
    """A callback that takes the share done (0 to 1), and reports it in per mille."""

    def take(done: float, what: str) -> None:
        del what
        report(round(1000.0 * done), 1000)

    return take


@contextmanager
def progress(
    label: str, unit: str = "frame sets", stream: TextIO | None = None
) -> Iterator[Progress]:
    """Show how far long work is, with the time left, on stderr.

    On a terminal it is a bar; elsewhere a line every few seconds.

    Args:
        label: what is being done ("measuring").
        unit: what is counted, plural.
        stream: where to; stderr if omitted.

    Yields:
        A function to call with what is done and the total.
    """
    out = sys.stderr if stream is None else stream
    if out.isatty():
        with _bar(label, unit, out) as report:
            yield report
    else:
        yield ProgressLines(label, unit, out)


@contextmanager
def _bar(label: str, unit: str, out: TextIO) -> Iterator[Progress]:
    from rich import progress as rich_progress
    from rich.text import Text

    pace = ProgressClock(time.monotonic())

    class Clock(rich_progress.ProgressColumn):
        """How many are done, and the clock."""

        def render(self, task: rich_progress.Task) -> Text:
            del task
            return Text(_so_far(pace, unit, time.monotonic()))

    with rich_progress.Progress(
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(),
        Clock(),
        console=Console(file=out),
        transient=True,
    ) as bar:
        bar.add_task(label, total=None)
        (task,) = bar.tasks

        def report(done: int, total: int | None) -> None:
            pace.note(done, total, time.monotonic())
            task.total = pace.total
            bar.update(task.id, completed=done)

        yield report


class ProgressLines:
    """Progress as lines of text, at most one every few seconds."""

    def __init__(
        self, label: str, unit: str, out: TextIO, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._label, self._unit, self._out, self._clock = label, unit, out, clock
        self._last = clock()
        self._pace = ProgressClock(self._last)

    def __call__(self, done: int, total: int | None) -> None:
        """Print a line if the last one is some seconds old."""
        now = self._clock()
        self._pace.note(done, total, now)
        if now - self._last >= _LINE_EVERY_S:
            self._last = now
            text = _so_far(self._pace, self._unit, now)
            print(f"{self._label}: {text}", file=self._out, flush=True)


def _so_far(pace: ProgressClock, unit: str, now_s: float) -> str:
    """How many are done of how many, if any is or that is known, and the clock."""
    if not pace.done and pace.total is None:
        return pace.text(now_s)
    of = "" if pace.total is None else f"/{pace.total}"
    return f"{pace.done}{of} {unit}, {pace.text(now_s)}"


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _known_to_json(value: Any) -> Any:
    """What pydantic does not know: arrays, views, mappings of other kinds."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Iterable):
        return dict(value) if isinstance(value, Mapping) else list(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")
