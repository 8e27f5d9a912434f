"""A folder in which a rig is set up: what lies in it, and that nothing outside is touched."""

from __future__ import annotations

import csv
import glob
import time
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np

from measure.arrays import Bytes
from measure.errors import CalibrationError, ConfigError, MeasureError, RunError
from measure.reading import parse_toml, read_text
from measure.session import check_name, matching_files, read_picture
from measure.session.number_table import read_number_table

COLORS = "colours.toml"  # In the folder: colours that were learnt, and no measured body
EVENTS = "events.csv"  # In a run's folder: the time of each event and what it was


@dataclass(frozen=True)
class FolderContents:
    """Files that a set-up needs, the newest first; those beside recordings, copies, are last."""

    calibrations: tuple[Path, ...]
    bodies: tuple[Path, ...]
    boards: tuple[Path, ...]


def inside(folder: Path, name: str | Path) -> Path:
    """A path below a folder, links followed; ConfigError for one that leads out, or is none."""
    try:
        path, home = (folder / name).resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError):  # too long, a NUL, links in a circle
        raise ConfigError(f"{str(name)!r}: no file can be called so") from None
    if home != path and home not in path.parents:
        raise ConfigError(f"{name}: lies outside {folder}: put it into that folder")
    return path


def contents_of(folder: Path) -> FolderContents:
    """Look through a folder and the folders in it, but those of captures and runs."""
    kinds: dict[str, list[Path]] = {"balls": [], "cameras": [], "kind": []}
    made = {file.parent for kind in ("capture", "run") for file in folder.glob(f"*/{kind}.toml")}
    files = [file for file in folder.glob("*.toml") if file.name != COLORS]
    files += [file for file in folder.glob("*/*.toml") if file.parent not in made]
    for file in sorted(files, key=_copies_last):
        try:
            keys = parse_toml(read_text(file, ConfigError)).keys()
        except (MeasureError, tomllib.TOMLDecodeError):
            continue
        for kind, found in kinds.items():
            if kind in keys and not keys & {"capture", "session"}:
                found.append(file)
    return FolderContents(*(tuple(kinds[kind]) for kind in ("cameras", "balls", "kind")))


def _copies_last(file: Path) -> tuple[bool, float]:
    """What a recording holds was copied into it, and its time is that of the recording."""
    return (file.parent / "session.toml").is_file(), -file.stat().st_mtime


def described(file: Path, folder: Path) -> str:
    """A file of a folder in a line: its name, when it was written, and what it was made by."""
    written = f"{datetime.fromtimestamp(file.stat().st_mtime):%d %b %H:%M}"
    words = [str(file.relative_to(folder)), written]
    try:
        known = parse_toml(read_text(file, ConfigError))
    except (MeasureError, tomllib.TOMLDecodeError):
        known = {}
    if by := known.get("provenance", {}).get("capture"):
        words.append(f"by {by}")
    if (file.parent / "session.toml").is_file():
        words.append("a copy")
    return " · ".join(words)


def learnt_colors(file: Path) -> dict[str, Bytes]:
    """The colours that a body's file gives by samples: by ball, BGR (n, 3)."""
    if not file.is_file():
        return {}
    balls = parse_toml(read_text(file, ConfigError)).get("balls", [])
    given = {ball["name"]: ball["color"] for ball in balls}
    return {
        name: np.array(color["samples_bgr"], np.uint8)
        for name, color in given.items()
        if isinstance(color, dict) and "samples_bgr" in color
    }


def next_free(folder: Path, stem: str, suffix: str = "") -> str:
    """The first of `stem`-1, `stem`-2, ... that is not there."""
    number = 1
    while (folder / f"{stem}-{number}{suffix}").exists():
        number += 1
    return f"{stem}-{number}{suffix}"


def named_pictures(folder: Path, cameras: Iterable[str]) -> dict[str, Bytes]:
    """Pictures in a folder that are named like cameras (cam0.png), by camera, BGR (h, w, 3)."""
    names, found = [*cameras], dict[str, Bytes]()
    for name in names:
        if files := pictures_of(folder, name):
            found[name] = read_picture(files[0])
    if not found:
        raise CalibrationError(f"{folder} holds no picture named like a camera: {', '.join(names)}")
    return found


def pictures_of(folder: Path, camera: str) -> list[Path]:
    """Files in a folder that are named like a camera."""
    return matching_files(folder, f"{glob.escape(camera)}.*", CalibrationError)


def write_named(folder: Path, camera: str, pixels: Bytes) -> None:
    """Write a picture, BGR (h, w, 3), named like its camera; ConfigError if no file can be."""
    try:
        check_name(camera)
    except ValueError as problem:
        raise ConfigError(f"a camera's name: {problem}") from None
    _, data = cv2.imencode(".png", pixels)
    (folder / f"{camera}.png").write_bytes(data.tobytes())


def mark_event(run: Path, what: str, time_s: float | None = None) -> None:
    """Write down what happened in a run, now if no time is given; RunError if there is none."""
    if not (run / "run.toml").is_file():
        raise RunError(f"{run}: no run is there yet whose event could be marked")
    new = not (run / EVENTS).exists()
    with (run / EVENTS).open("a", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerows([("time_s", "event")] if new else [])
        rows.writerow((f"{time.time() if time_s is None else time_s:.6f}", what))


def events(run: Path) -> list[tuple[float, str]]:
    """The events that were marked during a run: when, in seconds since 1970, and what."""
    if not (run / EVENTS).exists():
        return []
    table = read_number_table(run / EVENTS, ("time_s",), error=RunError, words=("event",))
    return list(zip(table.columns["time_s"].tolist(), table.words["event"], strict=True))
