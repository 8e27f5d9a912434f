"""A folder in which a rig is set up: what lies in it, and that nothing outside is touched."""

from __future__ import annotations

import csv
import glob
import time
from collections.abc import Iterable
from pathlib import Path

import cv2

from measure.arrays import Bytes
from measure.errors import CalibrationError, ConfigError, RunError
from measure.session import check_name, matching_files, read_picture
from measure.tables import read_number_table

EVENTS = "events.csv"  # In a run's folder: the time of each event and what it was


def inside(folder: Path, name: str | Path) -> Path:
    """A path below a folder, links followed; ConfigError for one that leads out, or is none."""
    try:
        path, home = (folder / name).resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError):  # too long, a NUL, links in a circle
        raise ConfigError(f"{str(name)!r}: no file can be called so") from None
    if home != path and home not in path.parents:
        raise ConfigError(f"{name}: lies outside {folder}: put it into that folder")
    return path


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
