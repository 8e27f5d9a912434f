"""Whether a Matroska file (mkv, webm) is all there: its segment's size against the file's."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

_HEADER, _SEGMENT = 0x1A45DFA3, 0x18538067


def missing_bytes(path: Path) -> int:
    """How many bytes the file is shorter than it says.

    0 too where it does not say: a recorder that was stopped by force, or writes to a pipe, leaves
    the size of the segment open.

    Source: RFC 8794 (EBML), sections 4 to 6; RFC 9559 (Matroska), section 5.
    """
    with path.open("rb") as file:
        if _number(file, marked=True) != _HEADER or (size := _number(file)) is None:
            return 0
        file.seek(size, 1)
        if _number(file, marked=True) != _SEGMENT or (size := _number(file)) is None:
            return 0
        return max(file.tell() + size - path.stat().st_size, 0)


def _number(file: BinaryIO, marked: bool = False) -> int | None:
    """A variable-size integer, with its marker bit if it names an element; None if unknown."""
    first = file.read(1)
    length = 9 - first[0].bit_length() if first and first[0] else 0
    rest = file.read(max(length - 1, 0))
    if not length or len(rest) < length - 1:
        return None
    value = int.from_bytes(first + rest, "big")
    if marked:
        return value
    value &= (1 << 7 * length) - 1
    return None if value == (1 << 7 * length) - 1 else value
