"""Estimating online: states come in by UDP, corrections go back to their senders."""

from __future__ import annotations

import ctypes
import gc
import math
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Correction, Turns
from measure_learning.core.correction import Counters, GuardedModel, Refusal, follower_of, unfit
from measure_learning.core.offsets import Zeroing
from measure_learning.onnx import OnnxModel

_STATE = struct.Struct("<4sQdH")
_ANSWER, _ANSWER_TURN = struct.Struct("<4sQdB9f"), struct.Struct("<4sQdB18f")
_TRUE = struct.Struct("<4sQ4f")
_STATE_MAGICS, _ANSWER_MAGICS, _TRUE_MAGIC = (b"TBs1", b"TBs2"), (b"TBe1", b"TBe2"), b"TBp1"
_UPPER = [0, 1, 2, 4, 5, 8]  # places of the upper triangle in a covariance
STATUS = {reason: code for code, reason in enumerate(Refusal, start=2)}
_REASON = {code: reason for reason, code in STATUS.items()}
LARGEST = 65_507  # bytes in a datagram


@dataclass(frozen=True, eq=False)
class StatePacket:
    """A robot's state on its way to the estimator."""

    sequence: int
    time_s: float
    state: Floats
    turn: bool = False  # whether the rotation's error is asked for, too

    def pack(self) -> bytes:
        """As bytes."""
        head = _STATE.pack(_STATE_MAGICS[self.turn], self.sequence, self.time_s, len(self.state))
        return head + np.asarray(self.state, dtype="<f4").tobytes()

    @classmethod
    def unpack(cls, data: bytes) -> StatePacket | None:
        """From bytes; None if they are no such packet."""
        if len(data) < _STATE.size or data[:4] not in _STATE_MAGICS:
            return None
        _, sequence, time_s, count = _STATE.unpack_from(data)
        if len(data) != _STATE.size + 4 * count:
            return None
        state = np.frombuffer(data, dtype="<f4", offset=_STATE.size).astype(np.float64)
        return cls(sequence, time_s, state, data[:4] == _STATE_MAGICS[1])


@dataclass(frozen=True, eq=False)
class TruePacket:
    """A measured tip position on its way to the estimator."""

    sequence: int  # of the state at which it was measured
    position_mm: Floats
    sd_mm: float  # per axis

    def pack(self) -> bytes:
        """As bytes."""
        return _TRUE.pack(_TRUE_MAGIC, self.sequence, *self.position_mm, self.sd_mm)

    @classmethod
    def unpack(cls, data: bytes) -> TruePacket | None:
        """From bytes; None if they are no such packet, or not numbers."""
        if len(data) != _TRUE.size or data[:4] != _TRUE_MAGIC:
            return None
        _, sequence, *numbers = _TRUE.unpack(data)
        if not np.isfinite(numbers).all() or numbers[3] < 0:
            return None
        return cls(sequence, np.array(numbers[:3]), numbers[3])


@dataclass(frozen=True, eq=False)
class AnswerPacket:
    """An estimate on its way back."""

    sequence: int
    time_s: float
    answer: Correction | Refusal
    turn: bool = False  # whether it holds the rotation's error, too

    def pack(self) -> bytes:
        """As bytes."""
        form, numbers = _ANSWER_TURN if self.turn else _ANSWER, [float("nan")] * 18
        if isinstance(answer := self.answer, Refusal):
            status = STATUS[answer]
        else:
            numbers[:9] = answer.error_mm.tolist() + answer.covariance.take(_UPPER).tolist()
            if (turn := answer.turn) is not None:
                numbers[9:] = turn.vectors_rad.tolist() + turn.covariances.take(_UPPER).tolist()
            status = int(answer.unfamiliar)
        magic, kept = _ANSWER_MAGICS[self.turn], numbers[: 18 if self.turn else 9]
        return form.pack(magic, self.sequence, self.time_s, status, *kept)

    @classmethod
    def unpack(cls, data: bytes) -> AnswerPacket:
        """From bytes; EstimatorError if they are no such packet."""
        form = _ANSWER_TURN if (turn := data[:4] == _ANSWER_MAGICS[1]) else _ANSWER
        if len(data) != form.size or data[:4] not in _ANSWER_MAGICS:
            raise EstimatorError(f"an answer of {len(data)} bytes is not an estimator's")
        _, sequence, time_s, status, *numbers = form.unpack(data)
        if status > 1:
            return cls(sequence, time_s, _REASON[status], turn)
        correction = Correction(*_estimate(numbers[:9]), status == 1)
        if turn and not np.isnan(numbers[9]):
            correction = replace(correction, turn=Turns(*_estimate(numbers[9:])))
        return cls(sequence, time_s, correction, turn)


def _estimate(numbers: Sequence[float]) -> tuple[Floats, Floats]:
    """A vector (3,) and its covariance (3, 3)."""
    covariance = np.zeros((3, 3))
    covariance.put(_UPPER, numbers[3:])
    return np.array(numbers[:3]), covariance + np.triu(covariance, 1).T


_PRIORITY = 10  # Of SCHED_FIFO: above all ordinary processes, below the kernel's own threads
_CURRENT_AND_FUTURE = 3  # MCL_CURRENT | MCL_FUTURE of mlockall(2)


def claim_realtime() -> str:
    """Run before ordinary processes, memory locked; gives what the system refused, or ""."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (AttributeError, OSError) as problem:
        refused.append(f"priority ({getattr(problem, 'strerror', None) or 'not on this system'})")
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_CURRENT_AND_FUTURE):
            refused.append(f"locked memory ({os.strerror(ctypes.get_errno())})")
    except (AttributeError, OSError, TypeError):
        refused.append("locked memory (not on this system)")
    if not refused:
        return ""
    return (
        f"not in real time: the system refuses {' and '.join(refused)}: run as root, or let "
        "/etc/security/limits.conf allow rtprio 10 and memlock unlimited"
    )


Sender = tuple[str, int]  # Address and port

_BUFFER_BYTES = 4 << 20
_BATCH = 32  # Datagrams taken from the common socket before the lanes are looked at again
_MOST_QUEUED = 20_000  # Datagrams that the buffer of the common socket cannot exceed


class Lanes:
    """Receives datagrams, those of known senders first.

    Each known sender has a lane, a socket that is connected to it: the system puts its datagrams
    there and not into the common queue, where what strangers send, however much, could delay them
    or leave no room. Outside Linux, where sockets that share a port behave otherwise, all come by
    the common queue.
    """

    def __init__(self, address: Sender) -> None:
        """Listen; EstimatorError if it is impossible there."""
        self._common = _socket()
        try:
            self._common.bind(address)
        except (OSError, OverflowError) as problem:
            self._common.close()
            reason = getattr(problem, "strerror", None) or problem
            raise EstimatorError(
                f"cannot listen on udp://{address[0]}:{address[1]} ({reason}): choose another "
                "--port or --host"
            ) from None
        self._lanes: dict[Sender, socket.socket] = {}
        self._waiting: dict[Sender, int] = {}
        self._ready = selectors.DefaultSelector()
        self._ready.register(self._common, selectors.EVENT_READ)

    @property
    def address(self) -> Sender:
        """Where it listens."""
        host, port = self._common.getsockname()
        return str(host), int(port)

    def open(self, sender: Sender) -> None:
        """Give a sender a lane; it is used once what came before it has been read."""
        if sys.platform != "linux":
            return
        lane = _socket()
        try:
            # Only while it is bound: nobody else may share the port.
            for one in (self._common, lane):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            lane.bind(self._common.getsockname())
            lane.connect(sender)
        except OSError:  # its datagrams come by the common socket, as before
            lane.close()
            return
        finally:
            self._common.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        lane.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        self._lanes[sender], self._waiting[sender] = lane, _MOST_QUEUED

    def close_lane(self, sender: Sender) -> None:
        """A sender is known no more."""
        lane = self._lanes.pop(sender, None)
        if lane is None:
            return
        if self._waiting.pop(sender, None) is None:
            self._ready.unregister(lane)
        lane.close()

    def receive(self, timeout_s: float) -> Iterator[tuple[bytes, Sender]]:
        """Wait for datagrams; yield one of each lane, then some of the others."""
        ready = {key.fd for key, _ in self._ready.select(timeout_s)}
        for lane in list(self._lanes.values()):
            # One that was closed meanwhile, for its sender gave way, has no number any more.
            if lane.fileno() in ready and (received := _received(lane)) is not None:
                yield received
        if self._common.fileno() in ready:
            yield from self._common_ones()
        elif self._waiting:
            self._use(list(self._waiting))

    def send(self, data: bytes, sender: Sender) -> bool:
        """Send a datagram; whether that was possible."""
        try:
            self._common.sendto(data, sender)
        except OSError:  # a sender's port may be 0, its network down: the others still listen
            return False
        return True

    def close(self) -> None:
        """Stop listening."""
        for sender in list(self._lanes):
            self.close_lane(sender)
        self._ready.close()
        self._common.close()

    def _common_ones(self) -> Iterator[tuple[bytes, Sender]]:
        for _ in range(_BATCH):
            received = _received(self._common)
            if received is None:
                self._use(list(self._waiting))
                return
            yield received
        for sender in list(self._waiting):
            self._waiting[sender] -= _BATCH
            if self._waiting[sender] <= 0:
                self._use([sender])

    def _use(self, senders: list[Sender]) -> None:
        """Read their lanes from now on: what they sent before has been read."""
        for sender in senders:
            del self._waiting[sender]
            self._ready.register(self._lanes[sender], selectors.EVENT_READ)


def _socket() -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    out.setblocking(False)
    return out


def _received(place: socket.socket) -> tuple[bytes, Sender] | None:
    """A datagram, if one is there; an answer that could not be delivered is no reason to end."""
    with suppress(OSError):
        return place.recvfrom(LARGEST)
    return None


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
