"""Where results are written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from measure.errors import ConfigError, MeasureError


def is_one_of(out: Path, read: Iterable[Path]) -> bool:
    """Whether to write `out` is to write over one of the files that are read."""
    return out.exists() and any(file.exists() and out.samefile(file) for file in read)


def check_apart(*outs: Path) -> None:
    """Refuse to write several things into one file (ConfigError)."""
    for index, out in enumerate(outs):
        if out.resolve() in {other.resolve() for other in outs[:index]}:
            raise ConfigError(f"{out}: would be written twice: what is written needs a file each")


def check_writable(out: Path, *, folder_is_made: bool = False) -> None:
    """Refuse (ConfigError) a file that cannot be written, before long work is done for it.

    It is a folder, its folder is not there (unless that is made), or it must not be written; or it
    is a link, through which whoever made it could have any file written over.
    """
    folder = out.parent
    if out.is_symlink():
        raise ConfigError(
            f"{out}: is a link to {out.readlink()}: give the file itself, or remove the link"
        )
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; give the file to write")
    if folder_is_made:
        folder = next(there for there in out.absolute().parents if there.exists())
    if not folder.is_dir():
        raise ConfigError(f"{out}: cannot be written: there is no folder {folder}")
    if not os.access(out if out.exists() else folder, os.W_OK):
        raise ConfigError(f"{out}: cannot be written: permission denied")


def check_replaceable(out: Path, read: Callable[[Path], object], what: str) -> None:
    """Refuse a file as `check_writable` does, or one that is there and that `read` refuses."""
    check_writable(out)
    if out.exists() and out.stat().st_size:
        try:
            read(out)
        except MeasureError:
            raise ConfigError(f"{out} is there already and is no {what}: give a new file") from None


def check_page_writable(page: Path) -> None:
    """Refuse a file for a report as `check_writable` does, or that is there and is no page."""
    check_writable(page)
    if page.exists() and page.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{page} is there already and is no report: give a new file, or a .html")
