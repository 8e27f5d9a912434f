"""Where results are written."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from measure.errors import ConfigError


def is_one_of(out: Path, read: Iterable[Path]) -> bool:
    """Whether to write `out` is to write over one of the files that are read."""
    return out.exists() and any(file.exists() and out.samefile(file) for file in read)


def check_writable(out: Path) -> None:
    """Refuse a file that cannot be written, before long work is done for it.

    Raises:
        ConfigError: it is a folder, its folder is not there, or it must not be written.
    """
    folder = out.parent
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; give the file to write")
    if not folder.is_dir():
        raise ConfigError(f"{out}: cannot be written: there is no folder {folder}")
    if not os.access(out if out.exists() else folder, os.W_OK):
        raise ConfigError(f"{out}: cannot be written: permission denied")
