"""Rendered sessions that several test files measure."""

from __future__ import annotations

import fcntl
import re
import shutil
from pathlib import Path

import numpy as np

from measure.simulation import write_session
from tests.simulated.catalogue import scene_catalogue

STILL_SETS, STILL_HZ = 12, 30.0


def still_session(cache: Path) -> Path:
    """The scene `still` at 30 Hz, rendered by the first process that asks for it; read-only."""
    cache.mkdir(exist_ok=True)
    folder = cache / "still"
    with (cache / "still.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "truth.csv").exists():
            write_session(scene_catalogue()["still"], np.arange(STILL_SETS) / STILL_HZ, folder)
    return folder


def part_of(session: Path, frames: range, folder: Path) -> Path:
    """A session of some consecutive frame sets of another, called as its folder."""
    folder.mkdir(parents=True)
    for name in ("body.toml", "calibration.toml", "truth.csv"):
        shutil.copy(session / name, folder)
    text = (session / "session.toml").read_text("utf-8")
    named = re.sub('^name = ".*"$', f'name = "{folder.name}"', text, count=1, flags=re.MULTILINE)
    (folder / "session.toml").write_text(named, "utf-8")
    for stamps in session.glob("cam*.csv"):
        head, *rows = stamps.read_text("utf-8").split()
        times = [row.partition(",")[2] for row in rows[frames.start : frames.stop]]
        lines = [head, *(f"{number},{time}" for number, time in enumerate(times))]
        (folder / stamps.name).write_text("\n".join(lines) + "\n", "utf-8")
        (folder / stamps.stem).mkdir()
        pictures = sorted((session / stamps.stem).iterdir())[frames.start : frames.stop]
        for number, picture in enumerate(pictures):
            shutil.copy(picture, folder / stamps.stem / f"{number:06d}{picture.suffix}")
    return folder
