"""When each frame was taken: `frame,time_s`, the middle of the exposure, one clock for all."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import MeasureError, SessionError
from measure.reading import read_text

LATEST_S = 1e11
"""Latest time of a recording, seconds after 1970."""
_MAX_FRAME_NUMBER = 2.0**53
"""Largest whole number that is exact in double precision."""


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of a camera's frames.

    Attributes:
        frames: (n,) frame numbers, increasing.
        times_s: (n,) increasing.
    """

    frames: Ints
    times_s: Floats


def read_stamps(path: Path, camera: str) -> Stamps:
    """Read a file of `frame,time_s`.

    Raises:
        SessionError: with camera, file and line where a value is missing, is no number, is NaN, or
            goes backwards.
    """
    table = read_number_table(path, ("frame", "time_s"), f"camera '{camera}': ")
    frames, times = table.columns["frame"], table.columns["time_s"]
    where = f"camera '{camera}': {path}"
    for i in np.flatnonzero(~np.isfinite(times) | ~np.isfinite(frames) | (frames % 1 != 0)):
        raise SessionError(
            f"{where}:{table.lines[i]}: frame {frames[i]:g} has the time {times[i]:g}; "
            "both must be numbers, the frame a whole one"
        )
    for i in np.flatnonzero(np.abs(frames) > _MAX_FRAME_NUMBER):
        raise SessionError(
            f"{where}:{table.lines[i]}: frame {frames[i]:.0f}: numbers beyond "
            f"{_MAX_FRAME_NUMBER:.0f} cannot be told apart; number the frames, and their "
            "pictures, from 0"
        )
    for i in np.flatnonzero(np.abs(times) > LATEST_S):
        raise SessionError(
            f"{where}:{table.lines[i]}: frame {frames[i]:g} has the time {times[i]:.6g} s: are "
            "these milli-, micro- or nanoseconds? time_s holds seconds"
        )
    for i in np.flatnonzero(np.diff(times) <= 0):
        way = "goes backwards" if times[i + 1] < times[i] else "stands still"
        raise SessionError(
            f"{where}:{table.lines[i + 1]}: time {way}, from {times[i]:.6f} s (frame "
            f"{frames[i]:g}) to {times[i + 1]:.6f} s (frame {frames[i + 1]:g}); correct the stamp, "
            "or remove the row and its picture"
        )
    for i in np.flatnonzero(np.diff(frames) <= 0):
        raise SessionError(
            f"{where}:{table.lines[i + 1]}: frame {frames[i + 1]:g} follows frame {frames[i]:g}; "
            "frame numbers must increase"
        )
    return Stamps(frames.astype(np.int64), times)


@dataclass(frozen=True, eq=False)
class NumberTable:
    """A CSV file's rows.

    Attributes:
        columns: of numbers by name, each (n,).
        lines: of the file on which each row stands.
        words: columns of text by name.
    """

    columns: dict[str, Floats]
    lines: list[int]
    words: dict[str, list[str]]


def read_number_table(
    path: Path,
    needed: tuple[str, ...],
    prefix: str = "",
    error: type[MeasureError] = SessionError,
    *,
    empty_is_nan: bool = False,
    words: tuple[str, ...] = (),
) -> NumberTable:
    """Read the columns `needed` of a CSV file with a header line; others are passed over.

    Those called `words` hold text.

    Raises:
        error: a column is missing, a value is no number, or a row has more cells than the header;
            the message starts with `prefix`, file and line.
    """
    text = read_text(path, error)
    numbered = _numbered_rows(text, f"{prefix}{path}", error)
    _, first = next(numbered, (1, []))
    header = [name.strip() for name in first]
    if missing := [name for name in (*words, *needed) if name not in header]:
        raise error(
            f"{prefix}{path}:1: the header lacks {', '.join(missing)}; it must hold "
            f"{','.join((*words, *needed))}, it holds {','.join(header)[:80] or 'nothing'}"
        )
    where = [header.index(name) for name in needed]
    rows, lines = [], list[int]()
    texts: dict[str, list[str]] = {name: [] for name in words}
    for line, row in numbered:
        if any(cell.strip() for cell in row):
            place = f"{prefix}{path}:{line}"
            if any(cell.strip() for cell in row[len(header) :]):
                raise error(
                    f"{place}: {len(row)} cells under {len(header)} headings: are decimal commas "
                    "among them? Write points, and a heading for every column"
                )
            rows.append(_numbers(row, where, needed, place, error, empty_is_nan))
            lines.append(line)
            for name in words:
                texts[name].append(_cell(row, header.index(name)))
    if not rows:
        raise error(f"{prefix}{path}: has a header but no rows")
    values = np.array(rows, dtype=np.float64)
    return NumberTable({name: values[:, i] for i, name in enumerate(needed)}, lines, texts)


def _numbered_rows(
    text: str, place: str, error: type[MeasureError]
) -> Iterator[tuple[int, list[str]]]:
    """Rows with the numbers of the lines they end in."""
    reader = csv.reader(text.splitlines())
    try:
        for row in reader:
            yield reader.line_num, row
    except csv.Error as problem:
        raise error(
            f"{place}:{reader.line_num}: {problem}: is a quotation mark not closed?"
        ) from None


def _numbers(
    row: list[str],
    where: list[int],
    needed: tuple[str, ...],
    place: str,
    error: type[MeasureError],
    empty_is_nan: bool,
) -> list[float]:
    out = []
    for index, name in zip(where, needed, strict=True):
        cell = _cell(row, index)
        try:
            out.append(float("nan") if empty_is_nan and not cell else float(cell))
        except ValueError:
            raise error(f"{place}: {name} is {cell!r}, not a number") from None
    return out


def _cell(row: list[str], index: int) -> str:
    return row[index].strip() if index < len(row) else ""
