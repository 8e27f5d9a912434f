"""Estimating online: states come in by UDP, corrections go back to their senders."""

from __future__ import annotations

import gc
import math
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Correction
from measure_learning.core.datagrams import (
    LARGEST,
    AnswerPacket,
    Lanes,
    Sender,
    StatePacket,
    TruePacket,
)
from measure_learning.core.guard import Counters, GuardedModel, Refusal, unfit
from measure_learning.core.offline import follower_of
from measure_learning.core.offsets import Zeroing
from measure_learning.onnx import OnnxModel

DEFAULT_ADDRESS = ("127.0.0.1", 47_118)
MOST_SENDERS = 16  # Largest number of senders whose histories are kept
SILENT_S = 60.0
"""A sender that has sent no valid state for so long gives way to a new one, if there is no room."""
_MAX_STRANGERS_HZ = 1000  # Refusals sent in a second to senders without a history


@dataclass
class _History:
    """A sender's: the model as its states left it, and when the last valid one came."""

    guarded: GuardedModel
    heard_s: float


class EstimateServer:
    """Answers datagrams, each with a correction or a refusal, and counts both.

    Every sender (address and port) of a whole valid state has a history of its own, which nothing
    that others send changes. It is kept while the sender is active: where there is no room, new
    senders are refused. Senders with a history are answered first.

    Loopback unless another address is given: the packets are neither encrypted nor signed.
    """

    def __init__(
        self,
        model: OnnxModel,
        address: Sender = DEFAULT_ADDRESS,
        zeroing: Zeroing | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Listen at host and port (0 takes a free one); EstimatorError if that cannot be."""
        self.counters = Counters()
        self._model, self._zeroing, self._clock = model, zeroing, clock
        self._histories: dict[Sender, _History] = {}
        self._lanes = Lanes(address)
        self._durations = np.zeros(1 << 16)
        self._answered = 0
        self._second, self._strangers = 0, 0

    @property
    def address(self) -> Sender:
        """Where it listens."""
        return self._lanes.address

    def serve(
        self,
        seconds: float | None = None,
        on_interval: Callable[[EstimateServer], None] | None = None,
        interval_s: float = 5.0,
    ) -> None:
        """Answer until `seconds` are over, or for ever; `on_interval` shows the counters."""
        gc.collect()
        gc.freeze()  # what is loaded by now stays: collecting it would only cost milliseconds
        start = called = time.monotonic()
        while seconds is None or time.monotonic() - start < seconds:
            for data, sender in self._lanes.receive(0.2):
                self._respond(data, sender)
            now = time.monotonic()
            if on_interval is not None and now - called >= interval_s:
                called = now
                on_interval(self)

    def answer(self, data: bytes, sender: Sender) -> bytes:
        """The datagram that goes back for one that came in."""
        return self._judged(data, sender).pack()

    def _respond(self, data: bytes, sender: Sender) -> None:
        """Answer a datagram; how long that takes is kept of those that are corrected."""
        begun = time.perf_counter()
        answer = self._judged(data, sender)
        if isinstance(answer.answer, Refusal) and not self._may_refuse(sender):
            self.counters.unanswered += 1
            return
        packed = answer.pack()
        if not isinstance(answer.answer, Refusal):
            spent = time.perf_counter() - begun
            self._durations[self._answered % len(self._durations)] = spent
            self._answered += 1
        self.counters.unsent += not self._lanes.send(packed, sender)

    def _may_refuse(self, sender: Sender) -> bool:
        """Whether to tell a sender so: strangers are, but no more than so many a second."""
        if sender in self._histories:
            return True
        second = int(self._clock())
        if second != self._second:
            self._second, self._strangers = second, 0
        self._strangers += 1
        return self._strangers <= _MAX_STRANGERS_HZ

    def _judged(self, data: bytes, sender: Sender) -> AnswerPacket:
        if (true := TruePacket.unpack(data)) is not None:
            return self._measured(true, sender)
        packet = StatePacket.unpack(data)
        if packet is None:
            return AnswerPacket(0, float("nan"), self.counters.refuse(Refusal.MALFORMED))
        reason = None if math.isfinite(packet.time_s) else Refusal.NOT_A_NUMBER
        if reason is None and sender not in self._histories:  # else its history checks the state
            reason = unfit(self._model, packet.state, packet.time_s)
        answer: Correction | Refusal
        if reason is not None:
            answer = self.counters.refuse(reason)
        else:
            answer = self._corrected(packet, sender)
        return AnswerPacket(packet.sequence, packet.time_s, answer, packet.turn)

    def _measured(self, true: TruePacket, sender: Sender) -> AnswerPacket:
        """A true position moves the offsets of its sender."""
        history = self._histories.get(sender)
        if history is None:
            answer: Correction | Refusal = self.counters.refuse(Refusal.REPEATED)
        else:
            spread = true.sd_mm**2 * np.eye(3)
            answer = history.guarded.measured(true.position_mm, spread, true.sequence)
        return AnswerPacket(true.sequence, float("nan"), answer)

    def drift(self) -> str | None:
        """What the innovations of the true positions say of the cables, if any came."""
        followers = (one.guarded.follower for one in self._histories.values())
        monitors = [one.monitor for one in followers if one is not None and one.monitor.count]
        return max(monitors, key=lambda one: one.ratio).sentence() if monitors else None

    def _corrected(self, packet: StatePacket, sender: Sender) -> Correction | Refusal:
        """The correction of a whole and valid state."""
        history = self._histories.get(sender) or self._admitted(sender)
        if history is None:
            return self.counters.refuse(Refusal.CROWDED)
        answer = history.guarded.update(packet.state, packet.time_s, packet.sequence)
        if not isinstance(answer, Refusal):
            history.heard_s = self._clock()
        return answer

    def _admitted(self, sender: Sender) -> _History | None:
        """A new sender's history; None while all that there is room for are active."""
        if len(self._histories) >= MOST_SENDERS:
            silent = min(self._histories, key=lambda one: self._histories[one].heard_s)
            if self._clock() - self._histories[silent].heard_s < SILENT_S:
                return None
            del self._histories[silent]
            self._lanes.close_lane(silent)
        follower = follower_of(self._model)
        guarded = GuardedModel(self._model.another(), self._zeroing, self.counters, follower)
        history = self._histories[sender] = _History(guarded, self._clock())
        self._lanes.open(sender)
        return history

    def latency_us(self) -> dict[str, float]:
        """Median and 99th percentile of one update in this process, over the last 65 536."""
        kept = self._durations[: min(self._answered, len(self._durations))]
        if not len(kept):
            return {"p50_us": float("nan"), "p99_us": float("nan")}
        p50, p99 = np.percentile(kept, [50, 99]) * 1e6
        return {"p50_us": float(p50), "p99_us": float(p99)}

    def close(self) -> None:
        """Stop listening."""
        self._lanes.close()


class EstimateClient:
    """Sends states and receives estimates; one in flight at a time is enough for 1 kHz."""

    def __init__(
        self,
        address: tuple[str, int] = DEFAULT_ADDRESS,
        timeout_s: float = 0.5,
        *,
        turn: bool = False,
    ) -> None:
        """With `turn`, answers hold the error of the tip's rotation, too, if the model has it."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(timeout_s)
        self._socket.connect(address)
        self._sequence, self._turn = -1, turn

    def ask(self, state: Floats, time_s: float) -> AnswerPacket | None:
        """Send the next state and wait for its own answer; None if that did not come in time."""
        self._sequence += 1
        self.send(StatePacket(self._sequence, time_s, state, self._turn).pack())
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
