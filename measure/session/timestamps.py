"""When each frame was taken: `frame,time_s`, the middle of the exposure, one clock for all."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import SessionError
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
    """Read a file of `frame,time_s`, or with another heading of the time (see `time_columns`).

    Raises:
        SessionError: with camera, file and line where a value is missing, is no number, is NaN, or
            goes backwards.
    """
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

    Args:
        overwrite: replace offsets that are there by their sum with these.

    Raises:
        SessionError: an offset is there and is not to be replaced, or the file's cameras are not
            written as `[[cameras]]` tables.
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
