"""Event marks while cameras are measured: by UDP, as a stream of LSL, or typed."""

from __future__ import annotations

import json
import logging
import os
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Any

from measure.errors import ConfigError
from measure.host import needed
from measure_studio.capture.sources import POLL_S

_FORMS = "--marks takes udp://HOST:PORT, udp://:PORT for every network, or lsl:NAME"
TYPED = "stdin:"  # Each line of the standard input is a mark
_log = logging.getLogger(__name__)
_MOST_LETTERS = 1000
_Clock = Callable[[], float]
_Marks = Iterator[tuple[float, Any] | None]  # Time and text; None where nothing comes for a while


@contextmanager
def marks_received(
    addresses: Sequence[str], clock_s: _Clock, on_mark: Callable[[float, str], None]
) -> Iterator[None]:
    """Receive event marks meanwhile, each address in a thread of its own.

    Args:
        addresses: udp://HOST:PORT, lsl:NAME or `TYPED` each.
        clock_s: the time now, on the run's clock.
        on_mark: called, from these threads, with the time of a mark on that clock, and its text.

    Raises:
        ConfigError: an address is none, or taken.
    """
    over = Event()

    def work(marks: _Marks) -> None:
        while not over.is_set():
            if (mark := next(marks)) is not None:
                on_mark(mark[0], " ".join(str(mark[1]).split())[:_MOST_LETTERS])

    with ExitStack() as stack:
        sources = [_source(address, clock_s, stack) for address in addresses]
        for source in sources:
            thread = Thread(target=work, args=(source,))
            thread.start()
            stack.callback(thread.join)
        stack.callback(over.set)
        yield


def check_marks(addresses: Sequence[str]) -> None:
    """Refuse addresses as `marks_received` does, before anything is slow."""
    with ExitStack() as stack:
        for address in addresses:
            _source(address, float, stack)


def _source(address: str, clock_s: _Clock, stack: ExitStack) -> _Marks:
    if address == TYPED:
        return _from_lines(clock_s)
    scheme, _, rest = address.partition(":")
    host, _, port = rest.removeprefix("//").rpartition(":")
    try:
        if scheme == "lsl" and rest:
            return _from_lsl(needed("pylsl", "lsl"), rest, clock_s)
        if rest.startswith("//") and scheme == "udp" and port.isdecimal() and int(port):
            receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.settimeout(POLL_S)
            receiver.bind((host, int(port)))
            return _from_udp(receiver, clock_s)
    except (OSError, OverflowError, ConfigError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        raise ConfigError(f"--marks {address}: {reason}") from None
    raise ConfigError(f"--marks {address}: {_FORMS}")


def _from_udp(receiver: socket.socket, clock_s: _Clock) -> _Marks:
    """Text, or a JSON object whose `mark` is the text, at the time of its arrival."""
    while True:
        try:
            text = receiver.recv(65_536).decode("utf-8", "replace")
        except TimeoutError:
            yield None
            continue
        time_s = clock_s()
        with suppress(ValueError, TypeError, KeyError):
            text = json.loads(text)["mark"]
        yield time_s, text


def _from_lines(clock_s: _Clock) -> _Marks:
    """Lines of the standard input, at the time of their arrival; an empty one is an "event"."""
    lines = SimpleQueue[tuple[float, str]]()
    # Nothing interrupts a read that waits for a line: its thread ends with the program.
    Thread(target=_read_lines, args=(lines, clock_s), daemon=True).start()
    while True:
        try:
            yield lines.get(timeout=POLL_S)
        except Empty:
            yield None


def _read_lines(lines: SimpleQueue[tuple[float, str]], clock_s: _Clock) -> None:
    text = b""
    with suppress(OSError, ValueError, AttributeError):  # closed; None where there never was one
        while got := os.read(sys.stdin.fileno(), 4096):
            *whole, text = (text + got).split(b"\n")
            for line in whole:
                lines.put((clock_s(), line.decode("utf-8", "replace").strip() or "event"))
    _log.warning("--mark: the input has ended, so no more marks can be typed; measuring goes on")


def _from_lsl(lsl: Any, name: str, clock_s: _Clock) -> _Marks:
    """The first channel of a stream, at the time that LSL says, by this machine's clock."""
    while not (found := lsl.resolve_byprop("name", name, timeout=1.0)):
        yield None
    inlet = lsl.StreamInlet(found[0], processing_flags=lsl.proc_clocksync)
    while True:
        sample, stamp_s = inlet.pull_sample(timeout=POLL_S)
        ago_s = 0.0 if sample is None else lsl.local_clock() - stamp_s
        yield None if sample is None else (clock_s() - ago_s, sample[0])
