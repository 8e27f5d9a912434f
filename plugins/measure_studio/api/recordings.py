"""Recordings and runs that lie in the folder of a rig."""

from __future__ import annotations

import csv
import shutil
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from measure.api import Body, Camera, inside
from measure.arrays import Bools, Floats
from measure.errors import ConfigError, MeasureError
from measure.reading import parse_toml, read_text
from measure.results import read_run
from measure.session import dump_toml, write_body

_RUN, _SESSION, _BODY = "run.toml", "session.toml", "body.toml"


@dataclass(frozen=True)
class Recording:
    """A recorded session, or a run.

    Attributes:
        kind: which of them.
        at: when it was written.
        seconds: how long it is; None where that cannot be read.
        good: how many poses of a run are good.
        poses: of how many frame sets; 0 of a session.
        problem: why it cannot be read.
    """

    folder: Path
    kind: Literal["session", "run"]
    at: datetime
    seconds: float | None = None
    good: int = 0
    poses: int = 0
    problem: str = ""


def recordings_in(folder: Path) -> list[Recording]:
    """Sessions and runs in a folder, the newest first; what cannot be read says why."""
    files = [*folder.glob(f"*/{_SESSION}"), *folder.glob(f"*/{_RUN}")]
    found = [_run(file.parent) if file.name == _RUN else _session(file.parent) for file in files]
    return sorted(found, key=lambda one: one.at, reverse=True)


def delete_recording(folder: Path, name: str) -> None:
    """Delete a session or a run of a folder, and nothing else (ConfigError)."""
    there = inside(folder, name)
    if there == folder.resolve() or not any((there / file).is_file() for file in (_RUN, _SESSION)):
        raise ConfigError(f"{name} is neither a recording nor a run")
    shutil.rmtree(there)


def name_body(session: Path, body: Body) -> None:
    """Put a body that was found in a recording into it: it is then checked and measured by it."""
    table = parse_toml(read_text(session / _SESSION, ConfigError))
    write_body(session / _BODY, body)
    table["session"]["body"] = _BODY
    (session / _SESSION).write_text(dump_toml(table), "utf-8")


def trail_of(run: Path) -> tuple[Sequence[Camera], Floats, Bools]:
    """The cameras of a run, the places (n, 3) mm of its poses, and which of them are good (n,)."""
    read = read_run(run)
    return read.cameras, read.world_from_body.translation, read.unflagged[read.has_pose]


def _written(folder: Path, file: str) -> datetime:
    return datetime.fromtimestamp((folder / file).stat().st_mtime)


def _run(folder: Path) -> Recording:
    at = _written(folder, _RUN)
    try:
        read = read_run(folder)
        times_s = read.times_s
    except MeasureError as problem:
        return Recording(folder, "run", at, problem=str(problem))
    seconds = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    unfinished = "" if read.finished else "it did not come to its end"
    good = int(read.unflagged.sum())
    return Recording(folder, "run", at, seconds, good, len(times_s), unfinished)


def _stamps(folder: Path) -> list[Path]:
    """The files of a session that hold its cameras' times."""
    try:
        cameras = parse_toml(read_text(folder / _SESSION, ConfigError)).get("cameras", [])
    except (MeasureError, tomllib.TOMLDecodeError):
        return []
    named = [folder / str(one["timestamps"]) for one in cameras if "timestamps" in one]
    return [file for file in named if file.is_file()]


def _session(folder: Path) -> Recording:
    lengths = []
    for file in _stamps(folder):
        with file.open(encoding="utf-8", newline="") as table:
            times = [row["time_s"] for row in csv.DictReader(table) if "time_s" in row]
        try:
            lengths.append(float(times[-1]) - float(times[0]))
        except (IndexError, ValueError):
            continue
    at = _written(folder, _SESSION)
    return Recording(folder, "session", at, max(lengths, default=None))
