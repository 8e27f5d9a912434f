"""What lies in the folder in which a rig is set up."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from measure.errors import ConfigError, MeasureError
from measure.reading import parse_toml, read_text

COLORS = "colours.toml"  # In the folder: colours that were learnt, and no measured body


@dataclass(frozen=True)
class FolderContents:
    """Files that a set-up needs, the newest first; those beside recordings, copies, are last."""

    calibrations: tuple[Path, ...]
    bodies: tuple[Path, ...]
    boards: tuple[Path, ...]


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


def next_free(folder: Path, stem: str, suffix: str = "") -> str:
    """The first of `stem`-1, `stem`-2, ... that is not there."""
    number = 1
    while (folder / f"{stem}-{number}{suffix}").exists():
        number += 1
    return f"{stem}-{number}{suffix}"
