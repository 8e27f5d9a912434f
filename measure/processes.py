"""Worker processes, the progress of long work, clusters to hand it to, optional libraries."""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any, Protocol

from measure.errors import ConfigError, MeasureError

_M_ARENA_MAX = -8  # Of glibc's malloc.h
_HEAPS = 2


class Progress(Protocol):
    """Called with how many items are done, and of how many; None where the total is not known."""

    def __call__(self, done: int, total: int | None, /) -> None:
        """Show or note it."""


def quiet(done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


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


def needed(
    module: str, extra: str, user: str = "it", error: type[MeasureError] = ConfigError
) -> Any:
    """A library of an extra of this program, for a user of it; an error if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise error(f"{user} needs the extra '{extra}': pip install 'triball[{extra}]'") from None


_CONNECT_S = 10.0


@contextmanager
def connected(address: str, option: str) -> Iterator[tuple[Any, Any]]:
    """A client of the scheduler at an address, and the module `distributed`.

    ConfigError: the extra is missing, no scheduler answers, or it has no workers; the message names
    the option of the command line that gave the address.
    """
    distributed = needed("distributed", "cluster", option)
    if "://" not in address:
        raise ConfigError(f"{option} {address}: expected a scheduler's address, tcp://HOST:PORT")
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{option} {address}: no scheduler answers there ({reason})") from error
    try:
        if not client.scheduler_info().get("workers"):
            raise ConfigError(f"{option} {address}: the scheduler has no workers; start some")
        yield client, distributed
    finally:
        client.close()
