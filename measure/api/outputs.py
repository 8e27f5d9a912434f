"""Where results are written: what is there stays as it is, unless `overwrite` says otherwise.

What is refused is refused before anything is done, by ConfigError, with the file's name and the
option. What is replaced is replaced when the new is whole: a failure leaves the old.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import disk_usage, rmtree
from tempfile import TemporaryDirectory, mkstemp

from filelock import lock_descriptor

from measure.errors import ConfigError, MeasureError
from measure.reading import kind_of_file
from measure.results.folder import why_unwritable

_LOCK = ".lock"
_FAULTS = {
    errno.ENOSPC: "{disk} is full ({free})",
    errno.EDQUOT: "your share of {disk} is used up ({free} in all)",
    errno.EFBIG: "it is larger than files may be here (a limit of this process, `ulimit -f`, or of "
    "{disk})",
    errno.EROFS: "{disk} can only be read",
    errno.EIO: "{disk} fails",
}
"""Errors that are a disk's, in words."""


def check_file(out: Path, overwrite: bool, read: Iterable[Path] = ()) -> None:
    """Refuse a file that is there already, or one of those to be `read`, or that cannot be one.

    A link is refused, too: whoever made it could have any file written over. So are devices and
    pipes, which a file would replace.
    """
    there = _nearest_folder(out)
    if out.exists() and any(file.exists() and out.samefile(file) for file in read):
        raise ConfigError(f"{out}: is one of the files to be read: choose another --out")
    refuse_link(out)
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; give the file to write")
    if out.exists() and not out.is_file():
        what = kind_of_file(out.stat().st_mode)
        raise ConfigError(f"{out}: is {what}, not an ordinary file: give a file to write")
    if out.exists() and not overwrite:
        raise ConfigError(f"{out}: is there already: --overwrite replaces it")
    if not there.is_dir():
        raise ConfigError(f"{out}: cannot be written: {there} is no folder")
    if not os.access(out if out.exists() else there, os.W_OK):
        why = os.strerror(why_unwritable(there))
        raise ConfigError(f"{out}: cannot be written: {why[:1].lower()}{why[1:]}")


def refuse_link(out: Path) -> None:
    """Refuse to write what a link leads to: whoever made it could have anything written over."""
    if out.is_symlink():
        kind = "folder" if out.is_dir() else "file"
        raise ConfigError(
            f"{out}: is a link to {out.readlink()}: give the {kind} itself, or remove the link"
        )


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
    with _place_for(out) as scratch:
        fresh = scratch / (out.name if out else "nowhere")
        try:
            yield fresh
            if out is not None:
                out.parent.mkdir(parents=True, exist_ok=True)
                for made in scratch.iterdir():
                    made.replace(out.with_name(made.name))
        except (MeasureError, OSError) as problem:
            if out is None:
                raise
            if (fault := _fault_of_disk(problem)) is not None:
                raise ConfigError(_told(fault, out, scratch)) from problem
            if isinstance(problem, OSError) or str(fresh) not in str(problem):
                raise
            # The user knows his file by its own name.
            raise type(problem)(str(problem).replace(str(fresh), str(out))) from None


def _fault_of_disk(problem: BaseException | None) -> OSError | None:
    """The error of a disk that an error is, or was made from: by a plugin that writes, say."""
    while problem is not None:
        if isinstance(problem, OSError) and problem.errno in _FAULTS:
            return problem
        problem = problem.__cause__ or problem.__context__
    return None


def _told(fault: OSError, out: Path, scratch: Path) -> str:
    """Which file and which disk an error is of."""
    file = Path(os.fsdecode(fault.filename)) if isinstance(fault.filename, str | bytes) else out
    file = out.with_name(file.name) if scratch in file.parents else file
    disk = _nearest_folder(file).resolve()
    while not disk.is_mount():
        disk = disk.parent
    free_kb = disk_usage(disk).free // 1000
    why = _FAULTS[fault.errno or 0].format(disk=f"the disk at {disk}", free=f"{free_kb} kB free")
    return f"{file}: cannot be written: {why}; what was there before is as it was"


def check_folder(out: Path, overwrite: bool, mark: str) -> None:
    """Refuse a folder that holds something; to be replaced it must hold the file `mark`.

    A link to a folder is refused as one to a file is.
    """
    refuse_link(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        if not (out / mark).is_file():
            raise ConfigError(f"{out}: is there already, and holds no {mark}: give a new folder")
        if not overwrite:
            raise ConfigError(f"{out}: is there already: --overwrite replaces it")


@contextmanager
def new_folder(out: Path, overwrite: bool, mark: str) -> Iterator[None]:
    """Make way for a folder as `check_folder` lets it; all is as before if the block fails."""
    check_folder(out, overwrite, mark)
    if not (out / mark).is_file():
        was_there = out.exists()
        try:
            yield
        except BaseException:
            for made in out.iterdir() if was_there else (out,):
                rmtree(made, ignore_errors=True) if made.is_dir() else made.unlink(missing_ok=True)
            raise
        return
    with TemporaryDirectory(prefix=".old-", dir=out.resolve().parent) as aside:
        old = out.resolve().rename(Path(aside) / "old")
        try:
            yield
        except BaseException:
            rmtree(out, ignore_errors=True)
            old.rename(out)
            raise


@contextmanager
def _place_for(out: Path | None) -> Iterator[Path]:
    if out is not None:
        with scratch_folder(_nearest_folder(out), ".new-") as scratch:
            yield scratch
    else:
        with TemporaryDirectory() as nowhere:
            yield Path(nowhere)


@contextmanager
def scratch_folder(where: Path, prefix: str) -> Iterator[Path]:
    """A new folder in a folder until the block ends; those that a killed process left are removed.

    Beside it stands a file that is locked while this process lives: what is not locked is nobody's.
    Where the file system has no locks nothing is removed.
    """
    for lock in where.glob(f"{prefix}*{_LOCK}"):
        _remove_if_left(lock)
    descriptor, name = _new_lock(where, prefix)
    scratch = Path(name.removesuffix(_LOCK))
    try:
        scratch.mkdir(mode=0o700)
        yield scratch
    finally:
        rmtree(scratch, ignore_errors=True)
        _release(descriptor, Path(name))


def _new_lock(where: Path, prefix: str) -> tuple[int, str]:
    """A new file, locked if that can be; before there is a folder to guard."""
    while True:
        descriptor, name = mkstemp(prefix=prefix, suffix=_LOCK, dir=where)
        try:
            ours = lock_descriptor(descriptor, blocking=False)
        except OSError:
            ours = True  # there are no locks: nobody removes it
        if ours and Path(name).exists():  # else another process took it for one that was left
            return descriptor, name
        os.close(descriptor)


def _remove_if_left(lock: Path) -> None:
    """Remove a scratch folder and its lock, if no living process holds that."""
    with suppress(OSError):
        descriptor = os.open(lock, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
        try:
            if not lock_descriptor(descriptor, blocking=False):
                os.close(descriptor)
                return
        except OSError:
            os.close(descriptor)
            raise
        rmtree(lock.with_name(lock.name.removesuffix(_LOCK)), ignore_errors=True)
        _release(descriptor, lock)


def _release(descriptor: int, lock: Path) -> None:
    """Remove a lock while it is held: nobody takes it for one that was left."""
    with suppress(OSError):
        lock.unlink()
    os.close(descriptor)


def _nearest_folder(out: Path) -> Path:
    """The folder that a file lies in, or that is above it and there."""
    return next(place for place in out.absolute().parents if place.exists())
