"""When each frame was taken, on one clock for all, and how wrong the stamps are by themselves."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import SessionError
from measure.limits import GAP_PERIODS
from measure.reading import read_text
from measure.session.number_table import read_number_table

LATEST_S = 1e11  # Latest time of a recording, seconds after 1970
_MAX_FRAME_NUMBER = 2.0**53  # Largest whole number that is exact in double precision


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of a camera's frames."""

    frames: Ints  # (n,) frame numbers, increasing
    times_s: Floats  # (n,) increasing


def read_stamps(path: Path, camera: str, time_column: str | None = None) -> Stamps:
    """Read `frame,time_s` (or see `time_columns`); SessionError with camera, file and line."""
    table = read_number_table(
        path, ("frame", "time_s"), f"camera '{camera}': ", time_column=time_column
    )
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
