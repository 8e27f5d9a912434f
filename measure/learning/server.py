"""Estimating online: states come in by UDP, corrections go back to their senders."""

from __future__ import annotations

import gc
import math
import socket
import time
from collections.abc import Callable

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import OnnxModel
from measure.learning.guard import Counters, GuardedModel, Refusal
from measure.learning.packets import LARGEST, AnswerPacket, StatePacket
from measure.learning.zeroing import Zeroing

DEFAULT_ADDRESS = ("127.0.0.1", 47_118)
_MOST_SENDERS = 16
"""Largest number of senders whose histories are kept; the one silent for longest is dropped."""


class EstimateServer:
    """Answers every datagram with one datagram, a correction or a refusal, and counts both.

    Every sender (address and port) has a history of its own.

    Loopback unless another address is given: the packets are neither encrypted nor signed.
    """

    def __init__(
        self,
        model: OnnxModel,
        address: tuple[str, int] = DEFAULT_ADDRESS,
        zeroing: Zeroing | None = None,
    ) -> None:
        self.counters = Counters()
        self._model, self._zeroing = model, zeroing
        self._histories: dict[tuple[str, int], GuardedModel] = {}  # the sender heard last is last
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        try:
            self._socket.bind(address)
        except (OSError, OverflowError) as problem:
            self._socket.close()
            reason = getattr(problem, "strerror", None) or problem
            raise EstimatorError(
                f"cannot listen on udp://{address[0]}:{address[1]} ({reason}): choose another "
                "--port or --host"
            ) from None
        self._durations = np.zeros(1 << 16)
        self._answered = 0

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def serve(
        self,
        seconds: float | None = None,
        on_interval: Callable[[EstimateServer], None] | None = None,
        interval_s: float = 5.0,
    ) -> None:
        """Answer until `seconds` are over, or for ever.

        Args:
            seconds: how long.
            on_interval: called every `interval_s`, to show the counters.
            interval_s: in seconds.
        """
        start = called = time.monotonic()
        self._socket.settimeout(0.2)
        gc.collect()
        gc.freeze()  # what is loaded by now stays: collecting it would only cost milliseconds
        while seconds is None or time.monotonic() - start < seconds:
            try:
                data, sender = self._socket.recvfrom(LARGEST)
            except TimeoutError:
                data = b""
            if data:
                self._send(self.answer(data, sender), sender)
            now = time.monotonic()
            if on_interval is not None and now - called >= interval_s:
                called = now
                on_interval(self)

    def answer(self, data: bytes, sender: tuple[str, int]) -> bytes:
        """The datagram that goes back for one that came in; how long it takes is kept."""
        begun = time.perf_counter()
        packed = self._judged(data, sender).pack()
        self._durations[self._answered % len(self._durations)] = time.perf_counter() - begun
        self._answered += 1
        return packed

    def _send(self, packed: bytes, sender: tuple[str, int]) -> None:
        try:
            self._socket.sendto(packed, sender)
        except OSError:  # a sender's port may be 0, its network down: the others still listen
            self.counters.unsent += 1

    def _judged(self, data: bytes, sender: tuple[str, int]) -> AnswerPacket:
        packet = StatePacket.unpack(data)
        if packet is None:
            return AnswerPacket(0, float("nan"), self.counters.refuse(Refusal.MALFORMED))
        if not math.isfinite(packet.time_s):
            reason = self.counters.refuse(Refusal.NOT_A_NUMBER)
            return AnswerPacket(packet.sequence, packet.time_s, reason)
        answer = self._guarded(sender).update(packet.state, packet.time_s, packet.sequence)
        return AnswerPacket(packet.sequence, packet.time_s, answer)

    def _guarded(self, sender: tuple[str, int]) -> GuardedModel:
        """The model with this sender's history."""
        guarded = self._histories.pop(sender, None)
        if guarded is None:
            guarded = GuardedModel(self._model.another(), self._zeroing, self.counters)
        self._histories[sender] = guarded
        if len(self._histories) > _MOST_SENDERS:
            del self._histories[next(iter(self._histories))]
        return guarded

    def latency_us(self) -> dict[str, float]:
        """Median and 99th percentile of one update in this process, over the last 65 536."""
        kept = self._durations[: min(self._answered, len(self._durations))]
        if not len(kept):
            return {"p50_us": float("nan"), "p99_us": float("nan")}
        p50, p99 = np.percentile(kept, [50, 99]) * 1e6
        return {"p50_us": float(p50), "p99_us": float(p99)}

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


class EstimateClient:
    """Sends states and receives estimates; one in flight at a time is enough for 1 kHz."""

    def __init__(self, address: tuple[str, int] = DEFAULT_ADDRESS, timeout_s: float = 0.5) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(timeout_s)
        self._socket.connect(address)
        self._sequence = -1

    def ask(self, state: Floats, time_s: float) -> AnswerPacket | None:
        """Send the next state and wait for its own answer; None if that did not come in time."""
        self._sequence += 1
        self.send(StatePacket(self._sequence, time_s, state).pack())
        while True:
            answer = self.receive()
            if answer is None or answer.sequence == self._sequence:
                return answer

    def send(self, data: bytes) -> None:
        """Send bytes as they are."""
        self._socket.send(data)

    def receive(self) -> AnswerPacket | None:
        """The next answer, or None if none comes in time."""
        try:
            return AnswerPacket.unpack(self._socket.recv(LARGEST))
        except (TimeoutError, ConnectionRefusedError):
            return None

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()
