"""Guards of a model online: checks of the states, a re-zero, offsets that are followed."""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from measure.arrays import Floats
from measure.host import Correction
from measure_learning.core.labels import FAR_MM
from measure_learning.core.offsets import OffsetFollower, Zeroing
from measure_learning.onnx import OnnxModel

_MAX_REORDERED = 100  # Largest number of packets by which a network brings one late
_MAX_LOST_IN_A_ROW = 1_000_000
"""Largest number of packets lost in a row: a quarter of an hour at 1 kHz."""
_JITTER_S = 1.0  # Largest step back of a stamp that is jitter, not a clock that was set
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest value of a feature: networks compute in float32."""
_REMEMBERED = 4096  # Corrected states whose true positions may still come
_MAX_PAUSE_S = 1000.0
"""Largest step ahead of a stamp; a longer one needs a second stamp that confirms it."""


class Refusal(StrEnum):
    """Why a state got no correction."""

    MALFORMED = "malformed packet"
    FEATURE_COUNT = "wrong number of features"
    NOT_A_NUMBER = "a feature is not a number"
    REPEATED = "sequence number repeated or out of order"
    STALE = "stamp not after the last one"
    LEAP = "stamp far ahead of the last one"
    CROWDED = "too many senders"
    FAR = "true position far from the reported one"
    CONTRADICTORY = "state contradicts itself: its joints and its tip disagree"


@dataclass
class Counters:
    """Counts of states and answers."""

    corrected: int = 0  # states that got a correction
    unfamiliar: int = 0  # of these, flagged as unlike training
    lost: int = 0  # sequence numbers that never came
    unsent: int = 0
    measured: int = 0  # true positions that came in
    unanswered: int = 0  # refusals that were not sent, for strangers sent too much
    refused: Counter[Refusal] = field(default_factory=Counter)

    def refuse(self, reason: Refusal) -> Refusal:
        """Count a refusal."""
        self.refused[reason] += 1
        return reason

    def values(self) -> dict[str, int]:
        """Plain names and numbers."""
        names = ("corrected", "unfamiliar", "lost", "unsent", "unanswered", "measured")
        out = {name: getattr(self, name) for name in names}
        return out | {reason.value: self.refused[reason] for reason in Refusal}


def unfit(model: OnnxModel, state: Floats, time_s: float) -> Refusal | None:
    """Why a state is none of this model's, whatever came before it; None if it is one."""
    if len(state) != len(model.features):
        return Refusal.FEATURE_COUNT
    if np.isinf(time_s) or not (np.abs(state) <= _MAX_FLOAT32).all():
        return Refusal.NOT_A_NUMBER
    return None


class GuardedModel:
    """A model that corrects valid states, and refuses and counts all others."""

    def __init__(
        self,
        model: OnnxModel,
        zeroing: Zeroing | None = None,
        counters: Counters | None = None,
        follower: OffsetFollower | None = None,
    ) -> None:
        self.model, self.follower = model, follower
        self._recent: OrderedDict[int, tuple[Floats, float, Correction]] = OrderedDict()
        self.counters = Counters() if counters is None else counters
        self.zeroing = zeroing
        self._last_sequence: int | None = None
        self._stray_sequence: int | None = None
        self._last_time_s = self._stray_time_s = np.nan

    def update(
        self, state: Floats, time_s: float, sequence: int | None = None
    ) -> Correction | Refusal:
        """Correct a state, re-zero included, or return why it is refused.

        Args:
            time_s: its stamp, which must grow; NaN where stamps are not recorded. Two that follow
                each other, but not the last one, begin a new trajectory: a clock was set.
            sequence: its number, which must grow by one; jumps count as losses. Zero begins a
                new trajectory, the robot's program was started again; so do two numbers that
                follow each other, but not the last one.
        """
        if (reason := unfit(self.model, state, time_s)) is not None:
            return self.counters.refuse(reason)
        if sequence is not None and self._begins_anew(sequence):
            self.reset()
        reason = self._judge(time_s, sequence)
        if reason in (Refusal.STALE, Refusal.LEAP) and self._clock_was_set(time_s):
            self.reset()
        elif reason is not None:
            return self.counters.refuse(reason)
        if sequence is not None:
            if self._last_sequence is not None:
                self.counters.lost += sequence - self._last_sequence - 1
            self._last_sequence = sequence
        self._last_time_s, self._stray_time_s = time_s, np.nan
        correction = self.model.update(state, time_s)
        if correction.contradictory:
            return self.counters.refuse(Refusal.CONTRADICTORY)
        self.counters.corrected += 1
        self.counters.unfamiliar += correction.unfamiliar
        if self.zeroing is not None:
            correction = replace(
                correction,
                error_mm=correction.error_mm + self.zeroing.offset_mm(state),
                covariance=correction.covariance + self.zeroing.covariance,
            )
        if self.follower is None:
            return correction
        number = self.counters.corrected if sequence is None else sequence
        self._recent[number] = state, time_s, correction
        if len(self._recent) > _REMEMBERED:
            self._recent.popitem(last=False)
        return self.follower.corrected(correction, state, time_s)

    def measured(
        self, true_mm: Floats, covariance: Floats, sequence: int | None = None
    ) -> Correction | Refusal:
        """Take the true tip position (3,) at a corrected state, the last or one by its number.

        Gives that state's correction by now.
        """
        number = next(reversed(self._recent), None) if sequence is None else sequence
        if self.follower is None or number is None or number not in self._recent:
            return self.counters.refuse(Refusal.REPEATED)
        state, time_s, correction = self._recent[number]
        if np.linalg.norm(true_mm - self.model.schema.position_mm(state)) > FAR_MM:
            return self.counters.refuse(Refusal.FAR)
        self.follower.add(correction, state, time_s, true_mm, covariance)
        self.counters.measured += 1
        return self.follower.corrected(correction, state, time_s)

    def reset(self) -> None:
        """A new trajectory begins; counters go on."""
        self.model.reset()
        self._recent.clear()
        if self.follower is not None:
            self.follower.forget()
        self._last_sequence = self._stray_sequence = None
        self._last_time_s = self._stray_time_s = np.nan

    def _begins_anew(self, sequence: int) -> bool:
        """One number far from the last is a slip, two in a row are not (RFC 3550, A.1)."""
        if sequence == 0:
            return True
        last, stray = self._last_sequence, self._stray_sequence
        near = last is None or -_MAX_REORDERED <= sequence - last <= _MAX_LOST_IN_A_ROW
        self._stray_sequence = None if near else sequence
        return not near and stray is not None and 0 < sequence - stray <= _MAX_REORDERED

    def _clock_was_set(self, time_s: float) -> bool:
        """Whether two stamps in a row are far from the last and follow each other."""
        stray = self._stray_time_s
        far = not -_JITTER_S <= time_s - self._last_time_s <= _MAX_PAUSE_S
        self._stray_time_s = time_s if far else np.nan
        return bool(far and 0 < time_s - stray <= _MAX_PAUSE_S)

    def _judge(self, time_s: float, sequence: int | None) -> Refusal | None:
        last = self._last_sequence
        step = 1 if sequence is None or last is None else sequence - last
        if not 0 < step <= _MAX_LOST_IN_A_ROW:
            return Refusal.REPEATED
        if time_s <= self._last_time_s:
            return Refusal.STALE
        if time_s - self._last_time_s > _MAX_PAUSE_S:
            return Refusal.LEAP
        return None
