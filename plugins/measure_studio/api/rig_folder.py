"""What lies in the folder in which a rig is set up."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from measure import api
from measure.errors import ConfigError, MeasureError
from measure.reading import parse_toml, read_text
from measure.session import dump_toml

_DICTIONARIES, _MARKER_SHARE = (50, 100, 250, 1000), 0.75
"""Markers that OpenCV's dictionaries of 4x4 hold, and their side over that of a square."""
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


def write_board(folder: Path, board: api.Board, name: str) -> Path:
    """Write a chessboard or a ChArUco board as a target file; ConfigError for one that is none."""
    if not isinstance(board, api.Charuco | api.Chessboard):
        raise ConfigError(f"{board.title}: only chessboards and ChArUco boards can be written here")
    given = {key: getattr(board, key) for key in board.__dataclass_fields__}
    kind = "charuco" if isinstance(board, api.Charuco) else "chessboard"
    squares = [count + 1 for count in board.inner_corners]
    title = f"{kind} of {squares[0]}x{squares[1]} squares, {board.square_mm:g} mm"
    kept = {key: list(value) if isinstance(value, tuple) else value for key, value in given.items()}
    file = folder / f"{name}.toml"
    before = file.read_bytes() if file.is_file() else None
    file.write_text(dump_toml({"kind": kind, "name": title, **kept}), "utf-8")
    try:
        api.read_board(file)
    except MeasureError:
        file.unlink()
        if before is not None:
            file.write_bytes(before)
        raise
    return file


def own_board(kind: str, columns: int, rows: int, square_mm: float) -> api.Board:
    """A board of so many squares; a ChArUco has markers of the smallest dictionary with enough."""
    if min(columns, rows) < 3 or not 0 < square_mm < math.inf:
        raise ConfigError("a board has 3 squares or more along each side, and they have a size")
    corners = columns - 1, rows - 1
    if kind == "chessboard":
        return api.Chessboard(corners, square_mm)
    held = next((size for size in _DICTIONARIES if size >= columns * rows // 2), _DICTIONARIES[-1])
    return api.Charuco(corners, square_mm, _MARKER_SHARE * square_mm, f"DICT_4X4_{held}")


def next_free(folder: Path, stem: str, suffix: str = "") -> str:
    """The first of `stem`-1, `stem`-2, ... that is not there."""
    number = 1
    while (folder / f"{stem}-{number}{suffix}").exists():
        number += 1
    return f"{stem}-{number}{suffix}"
