"""Event marks that the lab sends while cameras are measured: by UDP, or as a stream of LSL."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread
from typing import Any

from measure.errors import ConfigError
from measure.host import needed

_FORMS = "--marks takes udp://HOST:PORT, udp://:PORT for every network, or lsl:NAME"
_POLL_S, _MOST_LETTERS = 0.2, 1000
_Clock = Callable[[], float]
_Marks = Iterator[tuple[float, Any] | None]  # Time and text; None where nothing comes for a while


@contextmanager
def marks_received(
    addresses: Sequence[str], clock_s: _Clock, on_mark: Callable[[float, str], None]
) -> Iterator[None]:
    """Receive event marks meanwhile, each address in a thread of its own.

    Args:
        addresses: udp://HOST:PORT or lsl:NAME each.
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
    scheme, _, rest = address.partition(":")
    host, _, port = rest.removeprefix("//").rpartition(":")
    try:
        if scheme == "lsl" and rest:
            return _from_lsl(needed("pylsl", "lsl"), rest, clock_s)
        if rest.startswith("//") and scheme == "udp" and port.isdecimal() and int(port):
            receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.settimeout(_POLL_S)
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


def _from_lsl(lsl: Any, name: str, clock_s: _Clock) -> _Marks:
    """The first channel of a stream, at the time that LSL says, by this machine's clock."""
    while not (found := lsl.resolve_byprop("name", name, timeout=1.0)):
        yield None
    inlet = lsl.StreamInlet(found[0], processing_flags=lsl.proc_clocksync)
    while True:
        sample, stamp_s = inlet.pull_sample(timeout=_POLL_S)
        ago_s = 0.0 if sample is None else lsl.local_clock() - stamp_s
        yield None if sample is None else (clock_s() - ago_s, sample[0])
