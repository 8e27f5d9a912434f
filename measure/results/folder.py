"""A run's folder: what may become one, which of its files are the run's own, and its one writer."""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from filelock import lock_descriptor

from measure.errors import RunError
from measure.results.journal import unfinished, writing
from measure.results.tables import SCHEMAS

LOCK_FILE = "run.lock"
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class FolderLock:
    """The right to write into a run folder, until `release` or the end of this process.

    It is a lock on `run.lock`. The file itself means nothing: it says who holds the lock, `release`
    removes it, and one that a killed process left behind keeps nobody out. Between machines the
    lock is as good as the locks of the file system: those of NFS and SMB will do.
    """

    def __init__(self, folder: Path) -> None:
        """Take it; RunError if another process, or another writer of this one, holds it.

        RunError, too, where the file system has no locks; OSError: the folder cannot be written.
        """
        self._path = folder / LOCK_FILE
        self._descriptor = self._locked()
        # The first byte is what some systems lock, for readers too.
        mine = f"\n{json.dumps(_this_process())}\n".encode()
        with suppress(OSError):  # a full disk is reported by what needs the room
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, mine)

    def release(self) -> None:
        """Give it up; a second time does no harm."""
        if self._descriptor >= 0:
            # While it is locked: whoever opened it before finds out that it is no longer there.
            with suppress(OSError):
                self._path.unlink()
            os.close(self._descriptor)
            self._descriptor = -1

    def _locked(self) -> int:
        """A descriptor of the lock file, locked."""
        while True:
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o666)
            try:
                if not lock_descriptor(descriptor, blocking=False):
                    raise RunError(
                        f"{self._path.parent} is being written by {_holder(self._path)}: wait for "
                        "its end, or choose another folder with --out"
                    )
                if self._is_there(descriptor):
                    return descriptor
            except OSError as error:
                os.close(descriptor)
                if error.errno in _NO_LOCKS:
                    with suppress(OSError):
                        self._path.unlink()
                    raise RunError(
                        f"{self._path.parent}: its file system cannot lock files "
                        f"({error.strerror}), so that a second run could get in between: choose "
                        "a folder elsewhere with --out"
                    ) from error
                raise
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    def _is_there(self, descriptor: int) -> bool:
        """Whether the locked file still has its name, and is not one that was released just now."""
        try:
            return os.path.samestat(os.fstat(descriptor), self._path.stat())
        except FileNotFoundError:
            return False


def check_run_folder(folder: Path, resume: bool | None, overwrite: bool) -> None:
    """Refuse (RunError) as `refuse_folder`, and while another process writes a run there."""
    with writing(folder):
        if (folder / LOCK_FILE).exists():
            FolderLock(folder).release()
        refuse_folder(folder, resume, overwrite)


def _this_process() -> dict[str, str | int]:
    """The message to those who are kept out."""
    # Of the command no more than its name: what follows may hold a camera's password.
    program = [Path(word).name for word in sys.argv[:1]]
    words = [*program, *(word for word in sys.argv[1:2] if word.isalpha())]
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "command": " ".join(words),
        "since": datetime.now().astimezone().isoformat(" ", "seconds"),
    }


def _holder(path: Path) -> str:
    """The process that a lock file names, in words."""
    try:
        with path.open("rb") as file:
            file.seek(1)
            its = json.load(file)
        return f"process {its['pid']} on {its['host']} ({its['command']}, since {its['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


_BEFORE_A_RUN = {LOCK_FILE, unfinished(Path("run.toml")).name}
"""What may be left in a folder by a process that was killed before a run began."""


def refuse_folder(folder: Path, resume: bool | None, overwrite: bool) -> None:
    """Refuse a folder in which no run can be written, or not without losing one.

    Of a run that cannot be resumed `resume` is None.
    """
    if resume and overwrite:
        raise RunError("--resume goes on with a run, --overwrite throws it away: give one of them")
    if folder.is_symlink():
        there = folder.readlink()
        raise RunError(
            f"{folder}: is a link to {there}: give the folder itself, or remove the link"
        )
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file: choose a new folder with --out")
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        number = why_unwritable(there) if there.is_dir() else errno.ENOTDIR
        raise OSError(number, os.strerror(number))
    if (folder / "run.toml").exists():
        if not (resume or overwrite):
            goes_on = "" if resume is None else ", --resume goes on with it"
            raise RunError(f"{folder}: is there already: --overwrite replaces it{goes_on}")
    elif folder.exists() and not {file.name for file in folder.iterdir()} <= _BEFORE_A_RUN:
        raise RunError(f"{folder} holds files but no run: choose a new folder with --out")
    _refuse_links(folder)


def why_unwritable(place: Path) -> int:
    """The number of the error (`errno`) of writing where that is not allowed."""
    read_only = hasattr(os, "statvfs") and os.statvfs(place).f_flag & os.ST_RDONLY
    return errno.EROFS if read_only else errno.EACCES


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
    names = ["summary.json", "report.html", "run.rrd", "poses.csv", "relative.csv", "events.csv"]
    names += ["body.toml", "bodies.toml", "calibration.toml"]
    tables = (*SCHEMAS, "relative")
    names += [f"{table}.{kind}" for table in tables for kind in ("parquet", "arrows")]
    return [folder / name for name in (*names, "run.toml", LOCK_FILE)]


def clear(folder: Path) -> None:
    """Remove the files of an earlier run and no others; its `run.toml` is replaced."""
    for file in own_files(folder):
        if file.name not in ("run.toml", LOCK_FILE):
            file.unlink(missing_ok=True)
