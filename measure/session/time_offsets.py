"""Writing `time_offset_s` of cameras into the text of a session file, which keeps all else."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

from measure.errors import SessionError
from measure.reading import read_text

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
