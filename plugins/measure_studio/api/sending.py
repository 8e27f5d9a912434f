"""Poses sent on as they come: a thread for each sink, with a queue that never makes them wait."""

# Annotations are no texts here: cyclopts reads them of records that inherit these in other modules.

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, Full, Queue
from threading import Thread
from typing import Any, Self
from urllib.parse import parse_qsl

from measure.api import Measurement
from measure.api.profiles import parse_value
from measure.errors import ConfigError, MeasureError
from measure.host import EventMark, Registry, SentPose, SentRun, Sink
from measure.host.registry import failure
from measure.model import Image
from measure_studio.capture.sources import RETRY_S

_HELD = 256  # What waits for a sink at most; of more the oldest is lost
_LINGER_S = 0.3  # How long receivers may still read what was sent last
_LAST_S = 2.0  # Longest wait, at the end, for a sink to send what waits for it


@dataclass(frozen=True)
class SendOptions:
    """Where poses are sent.

    Attributes:
        send: where every pose is sent, such as udp://127.0.0.1:5005, igtl://, foxglove://,
            lsl:triball, zenoh:triball; may be repeated.
        sink_settings: SINK.NAME=VALUE each, for all sinks of that scheme.
        on_note: takes lines about them, from other threads.
    """

    send: tuple[str, ...] = ()
    sink_settings: tuple[str, ...] = ()
    on_note: Callable[[str], None] = print


def open_sending(options: SendOptions, registry: Registry, run: SentRun) -> "Sending":
    """What sends the poses of a run where it should.

    Raises:
        ConfigError: an address or setting that is none; the message lists the schemes.
        PluginError: the sink is broken.
    """
    schemes = [address.partition(":")[0] for address in options.send]
    chosen: dict[str, dict[str, Any]] = {scheme: {} for scheme in schemes}
    for text in options.sink_settings:
        key, equals, value = text.partition("=")
        scheme, dot, name = key.strip().partition(".")
        if not (equals and dot and scheme in chosen):
            known = ", ".join(chosen) or "none"
            raise ConfigError(f"--set {text}: expected SINK.NAME=VALUE, the sink one of: {known}")
        chosen[scheme][name] = parse_value(value)
    sinks = [
        (text.partition("?")[0], _build(text, chosen[scheme], registry, run))
        for scheme, text in zip(schemes, options.send, strict=True)
    ]
    for address, sink in sinks:
        for line in sink.notes:
            options.on_note(f"{address}: {line}")
    return Sending(sinks, options.on_note)


def _build(text: str, settings: Mapping[str, Any], registry: Registry, run: SentRun) -> Sink:
    scheme, colon, rest = text.partition(":")
    address, _, query = rest.removeprefix("//").partition("?")
    known = [registry.find("sink", name).plugin for name in registry.names("sink")]
    form_of = {one.name: getattr(one, "form", "") for one in known}
    forms = f"--send takes {', '.join(form_of.values())}"
    if scheme not in [*form_of, *(one.name for one in registry.broken)]:
        raise ConfigError(f"--send {text}: no sink is called '{scheme}'; {forms}")
    if not (colon and rest):
        raise ConfigError(f"--send {text}: expected {form_of.get(scheme) or 'an address'}")
    try:
        given = {**settings, **dict(parse_qsl(query))}
        return registry.build(Sink, scheme, given, address=address, run=run)
    except ConfigError as problem:
        raise ConfigError(f"--send {text}: {problem}; {forms}") from None


def sent_pose(
    measured: Measurement, body: str, reference: str = "", known_s: float | None = None
) -> SentPose:
    """A measurement of pictures that were taken when its clock says, as sinks get it.

    Args:
        known_s: the time now on that clock, which goes on evenly while the machine's is set; by
            default the machine's.
    """
    return SentPose(
        body,
        reference,
        measured.index,
        measured.time_s,
        exposed_s=measured.time_s,
        known_s=time.time() if known_s is None else known_s,
        status=measured.status.value,
        reason=measured.reason,
        pose=measured.pose,
        doubts=measured.doubts,
    )


class Sending:
    """Sends to several sinks; use it in a `with` block, at whose end each one's count is reported.

    Args:
        sinks: with their addresses.
        note: called, from other threads, with a line whenever a sink begins to lose poses, or no
            longer does.
    """

    def __init__(self, sinks: Sequence[tuple[str, Sink]], note: Callable[[str], None]) -> None:
        self._note = note
        self._outlets = [_Outlet(address, sink, note) for address, sink in sinks]

    def __enter__(self) -> Self:
        for one in self._outlets:
            one.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        until_s = time.monotonic() + _LAST_S
        for one in self._outlets:
            one.put(None, None)
        for one in self._outlets:
            one.thread.join(max(until_s - time.monotonic(), 0.0))
        for address, count in self.counts.items():
            self._note(f"{address}: {count['sent']} poses sent, {count['lost'] or 'none'} lost")

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """By address, how many poses were `sent` so far, and `lost`; those that wait count so."""
        sent = {one.address: one.sent for one in self._outlets}
        lost = {one.address: one.lost + one.waiting.qsize() for one in self._outlets}
        return {address: {"sent": sent[address], "lost": lost[address]} for address in sent}

    def send(
        self,
        poses: Sequence[SentPose],
        marks: Sequence[EventMark] = (),
        images: Mapping[str, Image] | None = None,
    ) -> None:
        """Send poses and marks, without waiting; pictures where nothing else waits."""
        for one in self._outlets:
            if images and one.sink.takes_pictures and one.waiting.empty():
                one.put(one.sink.send_pictures, images)
            for mark in marks:
                one.put(one.sink.send_mark, mark)
            for pose in poses:
                one.put(one.sink.send, pose)


class _Outlet:
    """One sink, the queue before it, and the thread that empties it."""

    def __init__(self, address: str, sink: Sink, note: Callable[[str], None]) -> None:
        self.address, self.sink, self._note = address, sink, note
        self.thread = Thread(target=self._work, daemon=True, name=address)
        self.waiting: Queue[tuple[Callable[[Any], None] | None, Any]] = Queue(_HELD)
        # Lost by the queue (counted by whoever puts), and by the sink (counted in its thread).
        self.sent = self._overrun = self._failed = 0
        self._is_open, self._reopen_at, self._problem = False, 0.0, ""

    @property
    def lost(self) -> int:
        """How many poses did not reach every receiver."""
        return self._overrun + self._failed + self.sink.undelivered

    def put(self, send: Callable[[Any], None] | None, item: Any) -> None:
        """Let it be sent in its turn; None for `send` ends the thread."""
        while True:
            try:
                return self.waiting.put_nowait((send, item))
            except Full:
                with suppress(Empty):
                    self._overrun += isinstance(self.waiting.get_nowait()[1], SentPose)

    def _work(self) -> None:
        known = 0
        send: Callable[[Any], object] | None = id  # does nothing: the first only opens it
        item: Any = None
        while send is not None:
            problem = self._deliver(send, item)
            if not problem and (self.lost > known or (self._problem and not self.waiting.empty())):
                problem = "it does not keep up"
            known = self.lost
            self._tell(problem)
            send, item = self.waiting.get()
        time.sleep(_LINGER_S)
        with suppress(Exception):
            self.sink.close()

    def _deliver(self, send: Callable[[Any], object], item: Any) -> str:
        """Send one, opening the sink if need be; returns what goes wrong."""
        is_pose = isinstance(item, SentPose)
        if not self._is_open and time.monotonic() < self._reopen_at:
            self._failed += is_pose
            return self._problem
        try:
            if not self._is_open:
                self.sink.open()
                self._is_open = True
            send(item)
        except Exception as error:
            self._failed += is_pose
            self._is_open, self._reopen_at = False, time.monotonic() + RETRY_S
            with suppress(Exception):
                self.sink.close()
            if isinstance(error, OSError | MeasureError):
                return getattr(error, "strerror", None) or str(error)
            return str(failure("sink", self.sink, self.address, error))
        self.sent += is_pose
        return ""

    def _tell(self, problem: str) -> None:
        """Say that poses begin to be lost, and that they no longer are; once each."""
        if problem and not self._problem:
            self._note(f"{self.address}: {problem}; its poses are lost until that is mended")
        elif self._problem and not problem:
            self._note(f"{self.address}: works again; {self.lost} poses were lost")
        self._problem = problem
