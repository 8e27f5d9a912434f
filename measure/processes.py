"""Long work: other processes that share it, and how much of it is done."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from threading import Thread
from typing import Protocol

_M_ARENA_MAX = -8  # Of glibc's malloc.h
_HEAPS = 2


class Progress(Protocol):
    """Called with how many items are done, and of how many; None where the total is not known."""

    def __call__(self, done: int, total: int | None, /) -> None:
        """Show or note it."""


def processes(count: int | None = None) -> ProcessPoolExecutor:
    """A pool of new processes, as many as there are cores by default.

    They end when this process does, even if it is killed: a pool's own would wait for work for ever
    and keep their memory.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    Thread(target=_wait_for_parent, name="end with parent", daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def usable_cores() -> int:
    """Those it is held to, where the system can tell; else all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_heaps() -> None:
    """Let the threads that are yet to begin allocate from two heaps, not from one each.

    Those of threads that decode pictures grow and do not shrink: in twenty minutes of live
    measurement with cameras that come and go they took 75 MB more. Only glibc has such heaps.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _HEAPS)
