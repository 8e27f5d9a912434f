"""The packets of the UDP interface, little-endian.

A state: magic `TBs1`, sequence number (uint64; zero begins a trajectory, without history), stamp
(float64, s), count (uint16), then `count` float32 features. An answer: magic `TBe1`, the same
sequence number and stamp, status (uint8: 0 corrected, 1 corrected but unfamiliar, 2 and above
refused, see `STATUS`; 8 means that the server has no room for a new sender's history), error x y z
(float32, mm; NaN if refused) and the upper triangle of its covariance (6 float32, mm^2).

A true position, from cameras that see the tip now and then: magic `TBp1`, the sequence number of
the state at which it was measured (uint64), x y z in the robot's frame and its SD per axis (4
float32, mm). The answer is that of the state as it would be now; status 5 where no such state was
corrected lately.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Correction
from measure.learning.guard import Refusal

_STATE = struct.Struct("<4sQdH")
_ANSWER = struct.Struct("<4sQdB9f")
_TRUE = struct.Struct("<4sQ4f")
_STATE_MAGIC, _ANSWER_MAGIC, _TRUE_MAGIC = b"TBs1", b"TBe1", b"TBp1"
_UPPER = np.triu_indices(3)
STATUS = {reason: code for code, reason in enumerate(Refusal, start=2)}
_REASON = {code: reason for reason, code in STATUS.items()}
LARGEST = 65_507  # bytes in a datagram


@dataclass(frozen=True, eq=False)
class StatePacket:
    """A robot's state on its way to the estimator."""

    sequence: int
    time_s: float
    state: Floats

    def pack(self) -> bytes:
        """As bytes."""
        head = _STATE.pack(_STATE_MAGIC, self.sequence, self.time_s, len(self.state))
        return head + np.asarray(self.state, dtype="<f4").tobytes()

    @classmethod
    def unpack(cls, data: bytes) -> StatePacket | None:
        """From bytes; None if they are no such packet."""
        if len(data) < _STATE.size or data[:4] != _STATE_MAGIC:
            return None
        _, sequence, time_s, count = _STATE.unpack_from(data)
        if len(data) != _STATE.size + 4 * count:
            return None
        state = np.frombuffer(data, dtype="<f4", offset=_STATE.size).astype(np.float64)
        return cls(sequence, time_s, state)


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

    def pack(self) -> bytes:
        """As bytes."""
        if isinstance(self.answer, Refusal):
            numbers = [float("nan")] * 9
            status = STATUS[self.answer]
        else:
            numbers = [*self.answer.error_mm, *self.answer.covariance[_UPPER]]
            status = int(self.answer.unfamiliar)
        return _ANSWER.pack(_ANSWER_MAGIC, self.sequence, self.time_s, status, *numbers)

    @classmethod
    def unpack(cls, data: bytes) -> AnswerPacket:
        """From bytes; EstimatorError if they are no such packet."""
        if len(data) != _ANSWER.size or data[:4] != _ANSWER_MAGIC:
            raise EstimatorError(f"an answer of {len(data)} bytes is not an estimator's")
        _, sequence, time_s, status, *numbers = _ANSWER.unpack(data)
        if status > 1:
            return cls(sequence, time_s, _REASON[status])
        covariance = np.zeros((3, 3))
        covariance[_UPPER] = numbers[3:]
        covariance = covariance + np.triu(covariance, 1).T
        return cls(sequence, time_s, Correction(np.array(numbers[:3]), covariance, status == 1))
