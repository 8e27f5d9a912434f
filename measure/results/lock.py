"""A run folder has one writer: a lock of the operating system, which ends with its process."""

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
from measure.results.files import writing

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
        """Take it.

        Args:
            folder: is there.

        Raises:
            RunError: another process, or another writer of this one, holds it; or there are no
                locks on this file system.
            OSError: the folder cannot be written.
        """
        self._path = folder / LOCK_FILE
        self._descriptor = self._locked()
        # The first byte is what some systems lock, for readers too.
        told = f"\n{json.dumps(_this_process())}\n".encode()
        with suppress(OSError):  # a full disk is told by what needs the room
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, told)

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


def refuse_other_writer(folder: Path) -> None:
    """Refuse a folder that another process is writing a run into.

    Raises:
        RunError: one is, or the folder cannot be written.
    """
    with writing(folder):
        if (folder / LOCK_FILE).exists():
            FolderLock(folder).release()


def _this_process() -> dict[str, str | int]:
    """What is told to those who are kept out."""
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
            told = json.load(file)
        return f"process {told['pid']} on {told['host']} ({told['command']}, since {told['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
