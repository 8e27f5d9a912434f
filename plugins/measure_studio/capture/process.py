"""What a process that reads cameras does about its end, and about its memory."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_M_ARENA_MAX = -8  # Of glibc's malloc.h


def share_heaps() -> None:
    """Let the threads that are yet to begin allocate from two heaps, not from one each.

    Those of threads that decode pictures grow and do not shrink: in twenty minutes of live
    measurement with cameras that come and go they took 75 MB more. Only glibc has such heaps.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


@contextmanager
def until_stopped(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """Turn the first interrupt (Ctrl-C) or termination of this process into an event.

    A second Ctrl-C ends the process as usual. Outside the main thread, the only one that receives
    signals, the event is not set by it.

    Args:
        stop: the event; a new one if omitted.

    Yields:
        Set once the work is to stop.
    """
    stop = stop or threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        stop.set()
        # A second termination means no more than the first: `timeout` sends two.
        signal.signal(signal.SIGINT, before[signal.SIGINT])

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
