"""Files of a run that come to be whole or not at all, and files that only grow."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from measure.errors import RunError

MEND = "fetch it from where the run was made, or measure anew with --overwrite"
"""What helps where a run's file is damaged or missing."""


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn a failed write into one line that says what is kept."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        what = "the disk is full" if full else f"cannot write ({error.strerror or error})"
        begun = os.path.exists(folder / "run.toml")  # noqa: PTH110 -- `Path.exists` raises on EACCES
        then = (
            "everything measured before is kept: mend that and go on with --resume"
            if begun
            else "nothing was begun: mend that, or choose another folder with --out"
        )
        raise RunError(f"{folder}: {what}; {then}") from error


def unfinished(path: Path) -> Path:
    """Where a file is written before it takes its place."""
    return path.with_name(f"{path.name}.new")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its place, which it takes in one step; if writing fails, not at all.

    Yields:
        Where to write.
    """
    fresh = unfinished(path)
    try:
        yield fresh
        fresh.replace(path)
    except BaseException:
        with suppress(OSError):
            fresh.unlink()
        raise


class GrowingFile:
    """A file that only grows, by whole pieces: one that does not fit leaves no trace.

    It grows beside its place until `take_place`; closed before that it is gone, and what was there
    before is as it was.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._in_place = path, False
        self._file: Any = unfinished(path).open("wb", buffering=0)

    def append(self, data: bytes) -> None:
        """Hand bytes to the operating system, where a kill of this process no longer matters.

        Raises:
            OSError: they cannot be written; the file is as before.
        """
        start = self._file.tell()
        try:
            done = 0
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(start)
            os.lseek(self._file.fileno(), start, os.SEEK_SET)
            raise

    def take_place(self) -> None:
        """Replace what was there before, in one step, and grow on there."""
        self._file.close()  # not every system renames an open file
        unfinished(self._path).replace(self._path)
        self._in_place = True
        self._file = self._path.open("ab", buffering=0)

    def close(self) -> None:
        """Close it; closing twice does no harm."""
        self._file.close()
        if not self._in_place:
            unfinished(self._path).unlink(missing_ok=True)
