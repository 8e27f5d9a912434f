"""Where results are written: what is there stays as it is, unless `overwrite` says otherwise.

What is refused is refused before anything is done, by ConfigError, with the file's name and the
option. What is replaced is replaced when the new is whole: a failure leaves the old.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory

from measure.errors import ConfigError, MeasureError


def check_file(out: Path, overwrite: bool, read: Iterable[Path] = ()) -> None:
    """Refuse a file that is there already, or one of those to be `read`, or that cannot be one.

    A link is refused, too: whoever made it could have any file written over.
    """
    there = _nearest_folder(out)
    if out.exists() and any(file.exists() and out.samefile(file) for file in read):
        raise ConfigError(f"{out}: is one of the files to be read: choose another --out")
    if out.is_symlink():
        raise ConfigError(
            f"{out}: is a link to {out.readlink()}: give the file itself, or remove the link"
        )
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; give the file to write")
    if out.exists() and not overwrite:
        raise ConfigError(f"{out}: is there already: --overwrite replaces it")
    if not there.is_dir():
        raise ConfigError(f"{out}: cannot be written: {there} is no folder")
    if not os.access(out if out.exists() else there, os.W_OK):
        raise ConfigError(f"{out}: cannot be written: permission denied")


def check_apart(*outs: Path) -> None:
    """Refuse to write several things into one file."""
    for index, out in enumerate(outs):
        if out.resolve() in {other.resolve() for other in outs[:index]}:
            raise ConfigError(f"{out}: would be written twice: what is written needs a file each")


@contextmanager
def output(
    out: Path | None, overwrite: bool = False, read: Iterable[Path] = (), beside: Iterable[str] = ()
) -> Iterator[Path]:
    """Yield where to write a file; at the end of the block it takes its place, folders made for it.

    Args:
        out: its place, refused as by `check_file`; without one it is thrown away.
        beside: endings of further files of this name that are written beside it.
    """
    if out is not None:
        for file in (out, *(out.with_suffix(ending) for ending in beside)):
            check_file(file, overwrite, read)
    with TemporaryDirectory(prefix=".new-", dir=out and _nearest_folder(out)) as scratch:
        fresh = Path(scratch) / (out.name if out else "nowhere")
        try:
            yield fresh
        except MeasureError as problem:  # the user knows his file by its own name
            if out is None or str(fresh) not in str(problem):
                raise
            raise type(problem)(str(problem).replace(str(fresh), str(out))) from None
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            for made in Path(scratch).iterdir():
                made.replace(out.with_name(made.name))


def check_folder(out: Path, overwrite: bool, mark: str) -> None:
    """Refuse a folder that holds something; to be replaced it must hold the file `mark`."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        if not (out / mark).is_file():
            raise ConfigError(f"{out}: is there already, and holds no {mark}: give a new folder")
        if not overwrite:
            raise ConfigError(f"{out}: is there already: --overwrite replaces it")


@contextmanager
def new_folder(out: Path, overwrite: bool, mark: str) -> Iterator[None]:
    """Make way for a folder as `check_folder` lets it; the old one is back if the block fails."""
    check_folder(out, overwrite, mark)
    if not (out / mark).is_file():
        yield
        return
    with TemporaryDirectory(prefix=".old-", dir=out.resolve().parent) as aside:
        old = out.resolve().rename(Path(aside) / "old")
        try:
            yield
        except BaseException:
            rmtree(out, ignore_errors=True)
            old.rename(out)
            raise


def _nearest_folder(out: Path) -> Path:
    """The folder that a file lies in, or that is above it and there."""
    return next(place for place in out.absolute().parents if place.exists())
