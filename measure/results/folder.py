"""A run's folder: what may become one, and which of its files are the run's own."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from measure.errors import RunError
from measure.results.files import unfinished
from measure.results.lock import LOCK_FILE
from measure.results.tables import SCHEMAS

_BEFORE_A_RUN = {LOCK_FILE, unfinished(Path("run.toml")).name}
"""What may be left in a folder by a process that was killed before a run began."""


def refuse_folder(folder: Path, resume: bool, overwrite: bool) -> None:
    """Refuse a folder in which no run can be written, or not without losing one."""
    if resume and overwrite:
        raise RunError("--resume goes on with a run, --overwrite throws it away: give one of them")
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file: choose a new folder with --out")
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        number = errno.EACCES if there.is_dir() else errno.ENOTDIR
        raise OSError(number, os.strerror(number))
    if (folder / "run.toml").exists():
        if not (resume or overwrite):
            raise RunError(
                f"{folder} holds a run already: --resume goes on, --overwrite starts anew"
            )
    elif folder.exists() and not {file.name for file in folder.iterdir()} <= _BEFORE_A_RUN:
        raise RunError(f"{folder} holds files but no run: choose a new folder with --out")
    _refuse_links(folder)


def _refuse_links(folder: Path) -> None:
    """Refuse to write through a link, which may lead to any file of the user's."""
    for file in own_files(folder):
        for place in (file, unfinished(file)):
            if place.is_symlink():
                raise RunError(
                    f"{place} is a link to {place.readlink()}, and nothing is written through one: "
                    "put the file itself in its place, or choose a new folder with --out"
                )


def own_files(folder: Path) -> list[Path]:
    """The files that are a run's own: those that are there, and those that may be."""
    # In the order in which they are removed: a run without its summary need not have all tables.
    names = ["summary.json", "report.html", "run.rrd", "poses.csv", "relative.csv"]
    names += ["body.toml", "bodies.toml", "calibration.toml"]
    tables = (*SCHEMAS, "relative")
    names += [f"{table}.{kind}" for table in tables for kind in ("parquet", "arrows")]
    return [folder / name for name in (*names, "run.toml", LOCK_FILE)]


def clear(folder: Path) -> None:
    """Remove the files of an earlier run and no others; its `run.toml` is replaced."""
    for file in own_files(folder):
        if file.name not in ("run.toml", LOCK_FILE):
            file.unlink(missing_ok=True)
