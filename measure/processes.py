"""How processes end, what they may use, progress, clusters to work on, optional libraries."""

from __future__ import annotations

import ctypes
import importlib
import math
import multiprocessing
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait
from threading import Thread
from types import FrameType, TracebackType
from typing import Any, ParamSpec, Protocol, TypeVar

from measure.errors import ConfigError, MeasureError

P = ParamSpec("P")
R = TypeVar("R")


class Progress(Protocol):
    """Called with how many items are done, and of how many; None where the total is not known."""

    def __call__(self, done: int, total: int | None, /) -> None:
        """Show or note it."""


def quiet(done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


class ProgressClock:
    """How long work goes on, and how long it takes yet: one clock for pages, bars and lines.

    The pace is counted from the first report on: what comes before it is start-up. Where more is
    done than was promised, nothing is promised any more.

    Attributes:
        done: how many are done.
        total: of how many; None where that is not known.
    """

    def __init__(self, now_s: float) -> None:
        self._begun_s, self.done = now_s, 0
        self.total: int | None = None
        self._first: tuple[float, int] | None = None

    def note(self, done: int, total: int | None, now_s: float) -> None:
        """Hear how many are done, and of how many."""
        if self._first is None or done < self.done:
            self._first = now_s, done
        self.done, self.total = done, total if total and done <= total else None

    @property
    def share(self) -> float | None:
        """How much is done, below 1 while it goes on; None where nobody knows."""
        return None if self.total is None or self.done >= self.total else self.done / self.total

    def text(self, now_s: float) -> str:
        """The clock: "elapsed 0:10, about 0:34 left"."""
        text = f"elapsed {_clock(now_s - self._begun_s)}"
        since_s, before = self._first or (now_s, self.done)
        if self.share is None or self.total is None or now_s <= since_s or self.done <= before:
            return text
        left_s = (self.total - self.done) * (now_s - since_s) / (self.done - before)
        return f"{text}, about {_clock(max(left_s, 1.0))} left"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02.0f}:{seconds:02.0f}" if hours else f"{minutes}:{seconds:02.0f}"


class Terminated(KeyboardInterrupt):
    """This process was asked to end by another signal than that of Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.signal = signal.Signals(number)


_ENDINGS = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
"""By which batch systems, `timeout`, service managers and closed terminals end a process."""
_TWICE_WITHIN_S, _AGAIN_AFTER_S = 2.0, 0.02
"""Signals within the one mean the same; after the other a destructor has ended."""
_UNWIND_S = 10.0
"""How long a worker may take to give up what it holds: a few frame sets, or a compilation."""


@contextmanager
def until_stopped(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """Turn the first interrupt (Ctrl-C), termination or hang-up of this process into an event.

    A second Ctrl-C ends the process as usual. A signal that is ignored (`nohup`, or `&` of a
    script) stays so. Outside the main thread, the only one that receives signals, the event is not
    set by them.

    Args:
        stop: the event; a new one if omitted.

    Yields:
        Set once the work is to stop.
    """
    stop = stop or threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *_ENDINGS)}
    heard = {n: handler for n, handler in before.items() if handler is not signal.SIG_IGN}

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        leave_closed_terminal()
        stop.set()
        # A second termination means no more than the first: `timeout` sends two.
        if signal.SIGINT in heard:
            signal.signal(signal.SIGINT, heard[signal.SIGINT])

    for number in heard:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in heard.items():
            signal.signal(number, handler)


def leave_closed_terminal() -> None:
    """Write no more to a terminal that was closed: each line would be an error."""
    for number in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(number).st_mode) and not os.isatty(number):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, number)
                os.close(nowhere)


@contextmanager
def unwound_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does: locks and scratch folders are given up.

    They raise `Terminated`, once in a while: `timeout` sends its signal twice. Whoever ignores one
    of them (`nohup`), or has a handler of his own, keeps that.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours = [number for number in _ENDINGS if signal.getsignal(number) is signal.SIG_DFL]
    raised_s, hook = -math.inf, sys.unraisablehook

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        nonlocal raised_s
        leave_closed_terminal()
        if time.monotonic() - raised_s > _TWICE_WITHIN_S:
            raised_s = time.monotonic()
            raise Terminated(number)

    def on_swallowed(swallowed: sys.UnraisableHookArgs) -> None:
        """Python swallows what is raised while it destroys an object: raise it again later."""
        nonlocal raised_s
        if isinstance(swallowed.exc_value, Terminated):
            raised_s = -math.inf
            again = os.getpid(), swallowed.exc_value.signal
            threading.Timer(_AGAIN_AFTER_S, os.kill, again).start()
        else:
            hook(swallowed)

    for number in ours:
        signal.signal(number, end)
    sys.unraisablehook = on_swallowed
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


class _Pool(ProcessPoolExecutor):
    """One whose processes are ended when its block is interrupted, with what they are at."""

    def submit(self, job: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Run a job in one of the processes, which ends if it is ended meanwhile."""
        return super().submit(_or_ended, partial(job, *args, **kwargs))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool | None:
        if kind is not None and not issubclass(kind, Exception):
            workers = list((self._processes or {}).values())
            self.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.terminate()
            left, until_s = {worker.sentinel for worker in workers}, time.monotonic() + _UNWIND_S
            while left and (rest_s := until_s - time.monotonic()) > 0:
                left -= set(wait(list(left), rest_s))
            for worker in workers:
                if worker.sentinel in left:
                    worker.kill()
        return super().__exit__(kind, error, trace)


def processes(count: int | None = None) -> ProcessPoolExecutor:
    """A pool of new processes, as many as there are cores by default.

    They end when this process does, even if it is killed: a pool's own would wait for work for ever
    and keep their memory.
    """
    context = multiprocessing.get_context("spawn")
    return _Pool(count, context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C goes to all; the parent says what it means
    signal.signal(signal.SIGTERM, _unwind)
    Thread(target=_wait_for_parent, name="end with parent", daemon=True).start()


def _unwind(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """End a worker; what it is at gives up its locks first."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + number)


def _or_ended(job: Callable[[], R]) -> R:
    """What a job returns; a process of a pool would outlive `_unwind`, and wait for other jobs."""
    try:
        return job()
    except SystemExit as end:
        if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN:
            os._exit(end.code if isinstance(end.code, int) else 1)
        raise


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


_M_ARENA_MAX = -8  # Of glibc's malloc.h


def share_heaps() -> None:
    """Let the threads that are yet to begin allocate from two heaps, not from one each.

    Those of threads that decode pictures grow and do not shrink: in twenty minutes of live
    measurement with cameras that come and go they took 75 MB more. Only glibc has such heaps.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


def usable_cores() -> int:
    """Those it is held to, where the system can tell; else all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def largest_file_bytes() -> int:
    """How large a file of this process may be (`ulimit -f`)."""
    return _limit("RLIMIT_FSIZE")


def address_space_bytes() -> int:
    """How many addresses this process may have (`ulimit -v`)."""
    return _limit("RLIMIT_AS")


def _limit(name: str) -> int:
    if sys.platform == "win32":
        return sys.maxsize
    import resource

    limit, _ = resource.getrlimit(getattr(resource, name))
    return sys.maxsize if limit == resource.RLIM_INFINITY else limit


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
