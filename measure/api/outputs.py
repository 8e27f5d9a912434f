"""Where results are written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def is_one_of(out: Path, read: Iterable[Path]) -> bool:
    """Whether to write `out` is to write over one of the files that are read."""
    return out.exists() and any(file.exists() and out.samefile(file) for file in read)
