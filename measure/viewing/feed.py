"""What a running viewer is sent: by a thread of its own, so that nobody waits for the viewer."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import chain
from queue import Empty, Queue
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

HELD_BYTES = 64 << 20
"""What waits for a viewer at most: more is not sent to it until it has taken some."""
SLOW_S = 3.0
"""A viewer that takes one message for so long does not keep up; the end waits no longer for it."""
_FLUSH_EVERY_S = 1.0
_POLL_S = 0.05


class ViewerFeed:
    """A recording that is sent to a viewer. If the viewer freezes or goes away, some of it is lost.

    Rerun's calls wait for the viewer without a limit, and nothing interrupts them: a daemon thread
    makes them. The methods are those of `rerun.RecordingStream`.

    Args:
        address: of the viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
        note: called, from any thread, with a line when the viewer does not keep up, when it takes
            everything again, and when it is gone.
        layout: how the viewer shows the recording.
        name: of the recording.
        part_of: recordings of one such name are shown as one.
    """

    def __init__(
        self,
        address: str,
        note: Callable[[str], None],
        layout: rrb.Blueprint,
        name: str = "",
        part_of: str | None = None,
    ) -> None:
        self._who, self._note = f"the viewer at {address}", note
        self._stream = rr.RecordingStream("triball", recording_id=part_of)
        self._waiting = Queue[tuple[int, Callable[[], object]] | None]()
        self._lock, self._held, self._left_out = threading.Lock(), 0, 0
        self._is_slow, self._is_gone, self._busy_since = False, False, math.inf
        # Rerun would wait for the viewer again when Python ends.
        rr.unregister_shutdown()
        sink = rr.GrpcSink(address)
        self._put(lambda: self._stream.set_sinks(sink, default_blueprint=layout))
        if name:
            self._put(lambda: self._stream.send_recording_name(name))
        self._thread = threading.Thread(target=self._work, daemon=True, name=address)
        self._thread.start()

    def log(self, entity: str, /, *what: Any, static: bool = False) -> None:
        """Log what happens at the time that is set, or what holds always."""
        # What holds always is sent once, and is in memory anyway: the rig, and whole videos.
        parts = () if static else chain(*(one.as_component_batches() for one in what))
        self._put(lambda: self._stream.log(entity, *what, static=static), *parts)

    def send_columns(
        self, entity: str, /, indexes: Iterable[Any], columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send the values of several instants."""
        kept = list(columns)
        batches = (column.component_batch for column in kept)
        self._put(lambda: self._stream.send_columns(entity, indexes, kept), *batches)

    def set_time(self, timeline: str, /, **when: Any) -> None:
        """Set the time of what is logged next."""
        self._put(lambda: self._stream.set_time(timeline, **when))

    def close(self) -> None:
        """Send what waits, unless the viewer does not keep up; an interrupt ends the wait."""
        self._waiting.put(None)
        with suppress(KeyboardInterrupt):
            while self._thread.is_alive() and not self._is_stuck():
                self._thread.join(_POLL_S)
        if self._thread.is_alive():
            self._tell_slow()

    def _put(self, send: Callable[[], object], *parts: rr.ComponentBatchLike) -> None:
        if self._is_gone:
            return
        size = sum(part.as_arrow_array().nbytes for part in parts)
        with self._lock:
            is_full = self._held > 0 and self._held + size > HELD_BYTES
            self._held += 0 if is_full else size
        self._left_out += is_full
        if not is_full:
            self._waiting.put((size, send))
        if is_full or self._is_stuck():
            self._tell_slow()

    def _is_stuck(self) -> bool:
        return time.monotonic() - self._busy_since > SLOW_S

    def _tell_slow(self) -> None:
        if not (self._is_slow or self._is_gone):
            self._is_slow = True
            self._note(f"{self._who} does not keep up: what it does not take is not shown there")

    def _work(self) -> None:
        try:
            flushed_s = time.monotonic()
            while (item := self._next()) is not None:
                size, send = item
                self._call(send)
                with self._lock:
                    self._held -= size
                if time.monotonic() - flushed_s > _FLUSH_EVERY_S:
                    self._flush()
                    flushed_s = time.monotonic()
            self._flush()
            self._call(self._stream.disconnect)
        except RuntimeError:  # the connection is severed
            self._is_gone = True
            self._note(f"{self._who} is gone: the rest is not shown there")

    def _next(self) -> tuple[int, Callable[[], object]] | None:
        """What is to be sent; now and then nothing, for what was sent to be flushed."""
        try:
            return self._waiting.get(timeout=_FLUSH_EVERY_S)
        except Empty:
            return 0, lambda: None

    def _flush(self) -> None:
        """Wait until the viewer has taken all; RuntimeError, which no other call raises: gone."""
        self._call(self._stream.flush)
        if self._is_slow:
            self._is_slow = False
            left_out = f"; {self._left_out} messages were left out" if self._left_out else ""
            self._note(f"{self._who} keeps up again{left_out}")

    def _call(self, send: Callable[[], object]) -> None:
        self._busy_since = time.monotonic()
        send()
        self._busy_since = math.inf
