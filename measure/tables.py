"""Tables of numbers as text, in the dialects that programs and spreadsheets write.

Cells are separated by commas, semicolons, tabs or spaces; where it is no comma, one may stand for
the decimal point. Times may be seconds, another unit that the heading states, ISO 8601, or ROS's
seconds and nanoseconds in two columns.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import MeasureError, SessionError
from measure.reading import read_text

TIME = "time_s"  # Our own heading
_SECONDS_AND_NANOSECONDS = (
    ("secs", "nsecs"),
    ("sec", "nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("header.stamp.sec", "header.stamp.nanosec"),
)
"""What ROS 1 and ROS 2 call the parts of a stamp."""
_ROSTOPIC = "field.header.stamp"  # In what `rostopic echo -p` writes: nanoseconds
_UNITS = {
    r"s|secs?|seconds?": 1.0,
    r"ms|msecs?|millis|milliseconds?": 1e-3,
    r"[uµμ]s|usecs?|micros|microseconds?": 1e-6,
    r"ns|nsecs?|nanos|nanoseconds?": 1e-9,
}
_WHOSE = (
    "frame|image|capture|exposure|sensor|camera|device|host|system|recording|elapsed|unix|epoch|"
    "robot|controller|header"
)
_HEADING = re.compile(
    rf"_*((?:{_WHOSE})[ _.]?)*(?:time[ _]?stamps?|times?|stamps?|ts?)"
    rf"(?:[ _]*[(\[]?(?P<unit>{'|'.join(_UNITS)})[)\]]?)?"
)


MISSING = frozenset([
    "", "NA", "N/A", "n/a", "#N/A", "#NA", "#N/A N/A", "NULL", "null", "NaN", "nan", "-NaN", "-nan",
    "1.#IND", "-1.#IND", "1.#QNAN", "-1.#QNAN",
])  # fmt: skip
"""What programs write where they have no number."""
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
STEPS_S = 1e-4, 1.0
"""Shortest and longest step from row to row that a tracker or a robot makes."""
TimeColumns = tuple[tuple[int, float], ...]
"""Where the time stands: the sum of columns, each with its position and its unit in s."""


def time_columns(header: Sequence[str], named: str | None = None) -> TimeColumns | None:
    """Find the time by the headings, or by its `named` one; None if none, or several, may be it."""
    if named is not None or TIME in header:
        name = TIME if named is None else named
        return ((header.index(name), stated_unit_s(name) or 1.0),) if name in header else None
    if _ROSTOPIC in header:
        return ((header.index(_ROSTOPIC), 1e-9),)
    for pair in _SECONDS_AND_NANOSECONDS:
        if all(name in header for name in pair):
            return (header.index(pair[0]), 1.0), (header.index(pair[1]), 1e-9)
    found = candidates(header)
    return ((header.index(found[0]), stated_unit_s(found[0]) or 1.0),) if len(found) == 1 else None


def candidates(header: Sequence[str]) -> list[str]:
    """The headings that may be of times."""
    return [name for name in header if _HEADING.fullmatch(name.lower())]


def stated_unit_s(heading: str) -> float | None:
    """The unit of time that a heading states; None if it states none."""
    found = re.search(r"(?:[ _(\[]|time|stamp|ts?)([a-zµμ]+)[)\]]?$", heading.lower())
    unit = found.group(1) if found else ""
    return next((s for names, s in _UNITS.items() if re.fullmatch(names, unit)), None)


@dataclass(frozen=True)
class Dialect:
    """How a table is written as text."""

    names: tuple[str, ...]  # of the columns
    head: int  # lines before the first row
    separator: str
    decimal: str
    encoding: str = "utf-8"

    @classmethod
    def of(cls, text: str, separator: str | None = None) -> Dialect:
        """Found by the first lines.

        Lines that begin with # stand before the header; the last is the header, if numbers follow.
        """
        lines = [*text.splitlines(), "", ""]
        content = (i for i, line in enumerate(lines) if line.strip() and not line.startswith("#"))
        if at := next(content, 0):
            cells = re.split("[,;\t ]+", lines[at].strip())
            mark = separator or _separator(lines[at - 1])
            alike = mark != " " and lines[at].count(mark) == lines[at - 1].count(mark) > 0
            if all(map(is_number, cells)) or (alike and any(map(is_number, filter(None, cells)))):
                at -= 1
        header = lines[at].lstrip("#% ").rstrip()
        mark = separator or _separator(header)
        row = next(csv.reader([header], delimiter=mark, skipinitialspace=True), [])
        comma = mark != "," and "," in lines[at + 1] and "." not in lines[at + 1]
        names = tuple(name.strip() for name in row)
        return cls(names, at + 1, mark, "," if comma else ".")


def _separator(line: str) -> str:
    found = max(",;\t", key=line.count)
    return found if found in line else " " if " " in line else ","


def is_number(text: str | None) -> bool:
    """Whether a cell is empty or a number."""
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True


@dataclass(frozen=True, eq=False)
class NumberTable:
    """A CSV file's rows."""

    columns: dict[str, Floats]  # of numbers by name, each (n,)
    lines: list[int]  # of the file on which each row stands
    words: dict[str, list[str]]


def read_number_table(
    path: Path,
    needed: tuple[str, ...],
    prefix: str = "",
    error: type[MeasureError] = SessionError,
    *,
    empty_is_nan: bool = False,
    words: tuple[str, ...] = (),
    time_column: str | None = None,
) -> NumberTable:
    """Read the columns `needed` of a table with a header line; others are passed over.

    Those called `words` hold text. The time may stand under other headings than `time_s` (see
    `time_columns`), or under `time_column`.

    Raises:
        error: a column is missing, a value is no number, or a row has more cells than the header;
            the message starts with `prefix`, file and line.
    """
    dialect = Dialect.of(text := read_text(path, error))
    header, place = [*dialect.names], f"{prefix}{path}"
    stamp = time_columns(header, time_column) if TIME in needed else None
    found = {*header} if stamp is None else {*header, TIME}
    if missing := [name for name in (*words, *needed) if name not in found]:
        lacks = _lacks(missing, (*words, *needed), header, time_column)
        quoted = any(dialect.separator in name for name in header)
        raise error(f"{place}:{dialect.head}: {lacks}{_QUOTED if quoted else ''}")
    columns = [stamp if stamp and name == TIME else ((header.index(name), 1.0),) for name in needed]
    rows, lines, texts = list[list[float]](), list[int](), {name: list[str]() for name in words}
    bad = list[tuple[int, _BadRowError]]()
    for line, cells in csv_rows(text, dialect.separator, error, place, dialect.head):
        row = [*map(str.strip, cells), *[""] * (len(header) - len(cells))]
        if not any(row):
            continue
        try:
            if any(row[len(header) :]):
                raise _BadRowError(f"{len(row)} cells under {len(header)} headings", _COMMAS)
            numbers = list[float]()
            for name, parts in zip(needed, columns, strict=True):
                values = [
                    unit_s * _number(row[i], header[i], dialect, name == TIME, empty_is_nan)
                    for i, unit_s in parts
                ]
                numbers.append(sum(values[1:], values[0]))
        except _BadRowError as fault:
            bad.append((line, fault))
            continue
        rows.append(numbers)
        lines.append(line)
        for name in words:
            texts[name].append(row[header.index(name)])
    if bad:
        line, first = bad[0]
        count = sum(other.cure == first.cure for _, other in bad) - 1
        more = f" (and {count} {'rows' if count > 1 else 'row'} more like it)" if count else ""
        raise error(f"{place}:{line}: {first}{more}{first.cure}")
    if not rows:
        raise error(f"{place}: has a header but no rows")
    table = np.array(rows, dtype=np.float64)
    return NumberTable({name: table[:, i] for i, name in enumerate(needed)}, lines, texts)


def _lacks(
    missing: list[str], needed: tuple[str, ...], header: list[str], time_column: str | None
) -> str:
    """What a header does not hold, must hold, and holds; in words."""
    names = [time_column or TIME if name == TIME else name for name in missing]
    times = candidates(header) if time_column is None and TIME in missing else []
    return (
        f"the header lacks {', '.join(names)}; it must hold {','.join(needed)}, it holds "
        f"{','.join(header)[:80] or 'nothing'}"
        + (f": which of {' and '.join(times)} holds it? Head it {TIME}" if times else "")
    )


class _BadRowError(ValueError):
    """A cell that is no number, or more cells than headings; the message says which."""

    def __init__(self, message: str, cure: str = "") -> None:
        super().__init__(message)
        self.cure = cure


_QUOTED = ": is a quotation mark not closed?"
_COMMAS = ": are decimal commas among them? Write points, and a heading for every column"


def _number(cell: str, name: str, dialect: Dialect, is_time: bool, empty_is_nan: bool) -> float:
    """A cell's number, or the seconds since 1970 of a time in ISO 8601, UTC if it names no zone."""
    if empty_is_nan and cell in MISSING:
        return float("nan")
    point = dialect.separator != "," and "." not in cell and cell.count(",") == 1
    with suppress(ValueError):
        return float(cell.replace(",", ".") if point else cell)
    if is_time:
        with suppress(ValueError):
            time = datetime.fromisoformat(cell)
            return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    raise _BadRowError(f"{name} is {cell!r}, not a number")


def csv_rows(
    text: str, separator: str, error: type[MeasureError], place: str, head: int = 0
) -> Iterator[tuple[int, list[str]]]:
    """Rows behind a table's head, with the numbers of the lines they end in, or an `error`."""
    lines = text.splitlines()[head:]
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=separator == " ")
    try:
        for row in reader:
            yield head + reader.line_num, row
    except csv.Error as problem:
        raise error(f"{place}:{head + reader.line_num}: {problem}{_QUOTED}") from None
