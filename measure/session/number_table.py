"""Tables of numbers as text, in the dialects that programs and spreadsheets write.

Cells are separated by commas, semicolons or tabs; between the latter two a comma may stand for the
decimal point. Times may be seconds, ISO 8601, or ROS's seconds and nanoseconds in two columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import MeasureError, SessionError
from measure.reading import TIME, TimeColumns, candidates, csv_rows, read_text, time_columns

_SEPARATORS = ",;\t"


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
    text = read_text(path, error)
    head = next(filter(str.strip, text.splitlines()), "")
    separator = max(_SEPARATORS, key=head.count)  # a comma if none is there
    numbered = csv_rows(text, separator, error, f"{prefix}{path}")
    _, first = next(numbered, (1, []))
    header = [name.strip().lstrip("#").strip() for name in first]
    stamp = time_columns(header, time_column) if TIME in needed else None
    found = {*header} if stamp is None else {*header, TIME}
    if missing := [name for name in (*words, *needed) if name not in found]:
        lacks = _lacks(missing, (*words, *needed), header, time_column)
        raise error(f"{prefix}{path}:1: {lacks}")
    reader = _RowReader(header, needed, separator, stamp, empty_is_nan)
    rows, lines, texts = list[list[float]](), list[int](), {name: list[str]() for name in words}
    for line, row in numbered:
        if any(cell.strip() for cell in row):
            try:
                rows.append(reader.numbers(row))
            except _BadRowError as bad:
                count = sum(_is_alike(bad, reader, later) for _, later in numbered)
                more = (
                    f" (and {count} {'rows' if count > 1 else 'row'} more like it)" if count else ""
                )
                raise error(f"{prefix}{path}:{line}: {bad}{more}{bad.cure}") from None
            lines.append(line)
            for name in words:
                texts[name].append(_cell(row, header.index(name)))
    if not rows:
        raise error(f"{prefix}{path}: has a header but no rows")
    values = np.array(rows, dtype=np.float64)
    return NumberTable({name: values[:, i] for i, name in enumerate(needed)}, lines, texts)


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


def _is_alike(bad: _BadRowError, reader: _RowReader, row: list[str]) -> bool:
    """Whether a later row has the same fault."""
    try:
        reader.numbers(row)
    except _BadRowError as other:
        return other.cure == bad.cure and any(cell.strip() for cell in row)
    return False


class _BadRowError(ValueError):
    """A cell that is no number, or more cells than headings; the message says which."""

    def __init__(self, message: str, cure: str = "") -> None:
        super().__init__(message)
        self.cure = cure


@dataclass(frozen=True)
class _RowReader:
    """Makes numbers of a row's cells."""

    header: list[str]
    needed: tuple[str, ...]
    separator: str
    stamp: TimeColumns | None
    empty_is_nan: bool

    def numbers(self, row: list[str]) -> list[float]:
        headings = len(self.header)
        if any(cell.strip() for cell in row[headings:]):
            cure = ": are decimal commas among them? Write points, and a heading for every column"
            raise _BadRowError(f"{len(row)} cells under {headings} headings", cure)
        return [self._value(row, name) for name in self.needed]

    def _value(self, row: list[str], name: str) -> float:
        if name == TIME and self.stamp is not None:
            return sum(
                unit_s * self._number(_cell(row, column), self.header[column], unit_s == 1.0)
                for column, unit_s in self.stamp
            )
        return self._number(_cell(row, self.header.index(name)), name)

    def _number(self, cell: str, name: str, may_be_date: bool = False) -> float:
        if self.empty_is_nan and not cell:
            return float("nan")
        text = cell
        if self.separator != "," and "." not in cell and cell.count(",") == 1:
            text = cell.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            if may_be_date and (time_s := _iso_seconds(cell)) is not None:
                return time_s
            raise _BadRowError(f"{name} is {cell!r}, not a number") from None


def _iso_seconds(cell: str) -> float | None:
    """Seconds since 1970 of a time in ISO 8601, UTC if it names no zone; None if it is none."""
    try:
        time = datetime.fromisoformat(cell)
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _cell(row: list[str], index: int) -> str:
    return row[index].strip() if index < len(row) else ""
