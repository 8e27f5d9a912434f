"""When each frame was taken, on one clock for all, and how wrong the stamps are by themselves."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import SessionError
from measure.limits import GAP_PERIODS, SINCE_1970_S
from measure.reading import read_text
from measure.tables import Dialect, NumberTable, read_number_table

LATEST_S = 1e11  # Latest time of a recording, seconds after 1970
_FILE_NAMES = {"filename", "file", "file_name", "image", "image_name", "path", "name"}
"""Headings of the names of pictures' files."""
_MAX_FRAME_NUMBER = 2.0**53  # Beyond the whole numbers that are exact, it is a stamp, no count
_LISTED = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s+([^\s,;]*[A-Za-z/][^,;]*)")
_NAMED_STAMP = re.compile(r"[0-9]{10,19}(?:\.[0-9]+)?")
_LATEST_NAMED_S, _DAY_S = 4e9, 86400.0


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of a camera's frames."""

    frames: Ints  # (n,) frame numbers, increasing
    times_s: Floats  # (n,) increasing
    names: tuple[str, ...] = ()  # of the frames' files, where they say which frame is which
    notes: tuple[str, ...] = ()  # what to know of how they were read


def read_stamps(path: Path, camera: str, time_column: str | None = None) -> Stamps:
    """Read `frame,time_s` (or see `time_columns`); SessionError with camera, file and line.

    A column of file names (EuRoC's `#timestamp [ns],filename`) stands for frame numbers, and so do
    stamps of ten or more digits as numbers; TUM's `rgb.txt` has seconds and a path in each line.
    """
    where = f"camera '{camera}': {path}"
    text = read_text(path, SessionError)
    if (listed := _listed(text)) is not None:
        times, names, lines = listed
        table = NumberTable({"frame": np.arange(float(len(times))), "time_s": times}, lines, {})
    else:
        header = Dialect.of(text).names
        named = next((name for name in header if name.lower() in _FILE_NAMES), "")
        needed, words = tuple[str, ...](("frame", "time_s")), tuple[str, ...]()
        if named and "frame" not in header:
            needed, words = ("time_s",), (named,)
        table = read_number_table(
            path, needed, f"camera '{camera}': ", words=words, time_column=time_column
        )
        numbers = table.columns.get("frame", np.zeros(0))
        if np.any(np.abs(numbers[np.isfinite(numbers)]) > _MAX_FRAME_NUMBER):
            words = ("frame",)
            table = read_number_table(path, needed, words=words, time_column=time_column)
        names = tuple(table.words[words[0]]) if words else ()
        if names:
            table.columns["frame"] = np.arange(float(len(names)))
    order = np.argsort(table.columns["frame"], kind="stable")  # as several threads wrote the rows
    frames, times = table.columns["frame"][order], table.columns["time_s"][order]
    lines = [table.lines[i] for i in order]
    for i in np.flatnonzero(~np.isfinite(times) | ~np.isfinite(frames) | (frames % 1 != 0)):
        raise SessionError(
            f"{where}:{lines[i]}: frame {frames[i]:g} has the time {times[i]:g}; "
            "both must be numbers, the frame a whole one"
        )
    for i in np.flatnonzero(np.abs(times) > LATEST_S):
        raise SessionError(
            f"{where}:{lines[i]}: frame {frames[i]:g} has the time {times[i]:.6g} s: are "
            "these milli-, micro- or nanoseconds? time_s holds seconds"
        )
    for i in np.flatnonzero(np.diff(times) <= 0):
        way = "goes backwards" if times[i + 1] < times[i] else "stands still"
        raise SessionError(
            f"{where}:{lines[i + 1]}: time {way}, from {times[i]:.6f} s (frame "
            f"{frames[i]:g}) to {times[i + 1]:.6f} s (frame {frames[i + 1]:g}); correct the stamp, "
            "or remove the row and its picture"
        )
    for i in np.flatnonzero(np.diff(frames) <= 0):
        raise SessionError(
            f"{where}:{lines[i + 1]}: frame {frames[i + 1]:g} follows frame {frames[i]:g}; "
            "frame numbers must increase"
        )
    moved = int(np.sum(order != np.arange(len(order))))
    note = f"{where}: {moved} rows were out of order and are sorted by their frame number"
    return Stamps(frames.astype(np.int64), times, names, (note,) if moved else ())


def _listed(text: str) -> tuple[Floats, tuple[str, ...], list[int]] | None:
    """Times, names and lines of a list with a time and a path in each line; None if it is none."""
    times, names, lines = list[float](), list[str](), list[int]()
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        found = _LISTED.fullmatch(line.strip())
        if found is None:
            return None
        times.append(float(found.group(1)))
        names.append(found.group(2))
        lines.append(number)
    return (np.array(times), tuple(names), lines) if times else None


def stamps_in_names(names: Sequence[str]) -> Stamps | None:
    """The times that the names of pictures, in order, hold; None if they hold none.

    The last number of each name, if all have ten digits or more, or ten and a fraction: a time of
    day in s, ms, us or ns, or else one that counts from the begin and makes 1 to 1000 steps a
    second.
    """
    found = [_NAMED_STAMP.findall(Path(name).stem) for name in names]
    if not all(found):
        return None
    texts = [numbers[-1] for numbers in found]
    values = np.array([float(text) for text in texts])
    if len(values) > 1 and np.any(np.diff(values) <= 0):
        return None
    steps = np.median(np.diff(values)) if len(values) > 1 else np.nan
    for unit_s in (1.0, 1e-3, 1e-6, 1e-9):
        of_day = np.all((values * unit_s > SINCE_1970_S) & (values * unit_s < _LATEST_NAMED_S))
        if of_day or (values[0] * unit_s < _DAY_S and 1e-3 <= steps * unit_s <= 1.0):
            return Stamps(np.arange(len(values)), values * unit_s, tuple(names))
    return None


_CAMERAS = re.compile(r"\s*\[\[\s*cameras\s*\]\]")
_OFFSET = re.compile(r"\s*time_offset_s\s*=[^#]*?(?=\s*(?:#|$))")


def add_time_offsets(path: Path, offsets_s: Mapping[str, float], overwrite: bool = False) -> str:
    """The text of a session file in which so much more is added to its cameras' times.

    Offsets that are there are replaced by their sum with these, if `overwrite` says so; else
    SessionError, as where cameras are not written as `[[cameras]]` tables.
    """
    lines = read_text(path, SessionError).splitlines()
    given = tomllib.loads("\n".join(lines))["cameras"]
    starts = [k for k, line in enumerate(lines) if _CAMERAS.match(line)]
    if len(starts) != len(given):
        entries = ", ".join(f"{name} {offset:+.6f}" for name, offset in offsets_s.items())
        raise SessionError(f"{path}: write [[cameras]] tables, or add to their times: {entries}")
    for start, camera in reversed(list(zip(starts, given, strict=True))):
        before = float(camera.get("time_offset_s", 0.0))
        total = before + offsets_s[camera["name"]]
        if before and not overwrite:
            raise SessionError(
                f"{path}: {camera['name']} has time_offset_s = {before:g} already: --overwrite "
                f"makes it {total:.6f}"
            )
        rest = range(start + 1, len(lines))
        end = next((k for k in rest if lines[k].lstrip().startswith("[")), len(lines))
        there = next((k for k in range(start + 1, end) if _OFFSET.match(lines[k])), None)
        entry = f"time_offset_s = {total:.6f}"
        if there is None:
            lines.insert(start + 1, entry)
        else:
            lines[there] = _OFFSET.sub(entry, lines[there])
    return "\n".join(lines) + "\n"


_QUANTA_S = (1.0, 0.1, 0.05, 0.04, 0.02, 0.016, 1 / 64, 0.01, 0.008, 0.005, 0.004, 0.002, 0.001)
_ROUNDED = 0.01  # Of a quantum, or a period: what is nearer to its multiples is one of them
_MIN_STAMPS = 8
_ARRIVAL_CORRELATION = -0.25
"""Of neighbouring steps: a late stamp lengthens one and shortens the next, which gives -0.5."""
_WORTH_A_LINE_S, _MAX_UNEVEN, _MAX_PERIOD_S = 1e-3, 0.1, 10.0
"""Errors, steps (in periods) and periods that are noted."""


@dataclass(frozen=True, eq=False)
class StampErrors:
    """What a camera's stamps show of their own errors."""

    sd_s: Floats  # (n,) standard deviation of each
    notes: tuple[str, ...] = ()  # what a user should know, without the camera's name

    @classmethod
    def of(cls, times_s: Floats) -> StampErrors:
        """Judge stamps (n,), increasing.

        The covariance of neighbouring steps is minus the variance of the stamps' errors if these
        are independent, whatever the steps' own changes (a moving average; Box & Jenkins 1976,
        section 3.3). A single late stamp counts with what it is off its neighbours.
        """
        sd, steps = np.zeros(len(times_s)), np.diff(times_s)
        if len(times_s) < _MIN_STAMPS:
            return cls(sd)
        period, notes = float(np.median(steps)), []
        whole = np.maximum(np.rint(steps / period), 1.0)
        off = steps - whole * period
        if quantum := _quantum_s(times_s, period):
            sd += quantum / math.sqrt(12)
            if sd[0] > _WORTH_A_LINE_S:
                notes.append(
                    f"stamps are rounded to {1e3 * quantum:.4g} ms: poses allow for "
                    f"{1e3 * sd[0]:.1f} ms; write more digits if they are known"
                )
        uneven = float(np.std(off[steps < GAP_PERIODS * period]))
        off = off - np.median(off)
        jitter = math.sqrt(max(-float(np.mean(off[1:] * off[:-1])), 0.0))
        arrived = jitter**2 > -_ARRIVAL_CORRELATION * float(np.mean(off**2))
        arrived &= jitter > max(1.5 * float(sd[0]), 0.1 * _WORTH_A_LINE_S)
        if arrived:
            span = times_s[2:] - times_s[:-2]
            both = np.maximum(np.rint(span / period), 2.0)
            line = times_s[:-2] + span * np.clip(whole[:-1], 1.0, both - 1) / both
            alone = np.pad(np.abs(times_s[1:-1] - line), 1)
            typical = max(1.06 * float(np.median(np.abs(off))), float(sd[0]))
            sd = np.hypot(typical, np.where(alone > 3 * typical, alone, 0.0))
        if period > _MAX_PERIOD_S:
            notes.append(
                f"{period:.1f} s from picture to picture: are the times milliseconds? Write "
                "seconds, or head the column time_ms"
            )
        elif uneven > _MAX_UNEVEN * period or (arrived and jitter > _WORTH_A_LINE_S):
            allowed = f"; poses allow for {1e3 * np.median(sd):.1f} ms" if arrived else ""
            notes.append(
                f"stamps {1e3 * uneven:.1f} ms uneven about {1e3 * period:.1f} ms: are they the "
                f"middles of the exposures, or arrival times?{allowed}"
            )
        return cls(sd, tuple(notes))


def _quantum_s(times_s: Floats, period_s: float) -> float:
    """What the stamps are rounded to; 0 if nothing shows it, as where every step is the same."""

    def multiples(values: Floats, unit: float) -> bool:
        return bool(np.all(np.abs(values / unit - np.rint(values / unit)) < _ROUNDED))

    if multiples(np.diff(times_s), period_s):
        return 0.0
    return next((q for q in _QUANTA_S if multiples(times_s - times_s[0], q)), 0.0)


def check_time_units(periods_s: Mapping[str, float]) -> None:
    """Refuse (SessionError) cameras whose stamps, by their median steps, are in different units."""
    known = sorted((period, name) for name, period in periods_s.items() if np.isfinite(period))
    ratio = known[-1][0] / known[0][0] if known else 1.0
    if any(abs(ratio / factor - 1) < 0.1 for factor in (1e3, 1e6, 1e9)):
        raise SessionError(
            f"pictures of camera '{known[-1][1]}' are {known[-1][0]:.4g} s apart by their stamps, "
            f"of '{known[0][1]}' {known[0][0]:.4g} s: one is in another unit; write seconds, or "
            "head the column by its unit (time_ms, time_us, time_ns)"
        )
