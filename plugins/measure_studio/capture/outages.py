"""Disconnected cameras: reported at once, once, and again when they are back."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

_MISSING = 3  # A camera is away when so many of its pictures in a row have not come
_GRACE_S = 0.5
"""How much later than due the last of them may come: networks and busy machines hold some up."""
_STEADY_S = 1.0
"""A camera is back once pictures have come for so long: one that stutters is away once."""
_STEPS = 16  # Latest steps from picture to picture whose median is a camera's period
_FIRST_PERIOD_S = 0.5  # Period assumed before any step is known
_LISTED = 1000  # Outages of a camera that are listed; of more, the latest


@dataclass(frozen=True)
class Outage:
    """A time in which a camera delivered no new picture."""

    camera: str
    since_s: float  # time of the last picture before, in seconds since 1970
    until_s: float = math.nan  # time of the first picture after; NaN while it lasts
    reason: str = "no picture came"

    @property
    def lasts(self) -> bool:
        """Whether the camera is still away."""
        return math.isnan(self.until_s)

    def sentence(self) -> str:
        """For people."""
        if self.lasts:
            return f"{self.camera} is away: {self.reason}"
        return f"{self.camera} is back after {self.until_s - self.since_s:.1f} s ({self.reason})"


@dataclass
class _Attendance:
    """What is known of a camera: times on our clock (`heard_s`) and the pictures' (`time_s`)."""

    heard_s: float = math.inf
    time_s: float = math.nan
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_STEPS))
    outage: Outage | None = None
    reported: bool = False
    back_s: float = math.inf
    back_time_s: float = math.nan
    trouble: str = ""
    # how many pictures in a row are of no use, by who found that.
    spoiled: Counter[str] = field(default_factory=Counter)
    past: deque[Outage] = field(default_factory=lambda: deque(maxlen=_LISTED))

    @property
    def period_s(self) -> float:
        return float(np.median(self.steps)) if self.steps else _FIRST_PERIOD_S

    @property
    def is_spoiled(self) -> bool:
        return max(self.spoiled.values(), default=0) >= _MISSING

    @property
    def away(self) -> bool:
        return self.outage is not None and math.isinf(self.back_s)


class OutageWatch:
    """Notices which cameras are away; the cameras' threads report pictures to it."""

    def __init__(self, names: Iterable[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._cameras = {name: _Attendance() for name in names}
        self._begun_s = math.nan

    @property
    def away(self) -> tuple[str, ...]:
        """The cameras whose pictures are missing now."""
        return tuple(name for name, one in self._cameras.items() if one.away)

    def of(self, name: str) -> tuple[Outage, ...]:
        """A camera's outages, the present one included."""
        one = self._cameras[name]
        with self._lock:
            lasting = () if one.outage is None else (_explained(one.outage, one),)
            return (*one.past, *lasting)

    def begin(self, time_s: float) -> None:
        """From now on all are expected to deliver; `time_s` is now, on the pictures' clock."""
        with self._lock:
            self._begun_s = time_s
            for one in self._cameras.values():
                one.heard_s = self._clock()

    def end(self, name: str) -> None:
        """No more is expected of this camera."""
        self._cameras[name].heard_s = math.inf

    def came(self, name: str, time_s: float, exact: bool) -> None:
        """A new picture of a camera came.

        Args:
            exact: whether that is of the camera's own clock. Then a step of several periods means
                that pictures are missing, otherwise that they may have been held up.
        """
        one, now = self._cameras[name], self._clock()
        with self._lock:
            step_s = time_s - one.time_s
            if exact and step_s > (_MISSING + 0.5) * one.period_s:
                self._miss(name, one)
            if one.outage is not None and math.isinf(one.back_s) and not one.is_spoiled:
                one.back_s, one.back_time_s = now, time_s
            if not math.isnan(step_s):
                one.steps.append(step_s)
            one.heard_s, one.time_s = now, time_s
            if one.outage is None:
                one.trouble = ""

    def fail(self, name: str, reason: str) -> None:
        """A camera broke off, or delivers what cannot be used."""
        self._cameras[name].trouble = reason

    def read(self, name: str, readable: bool) -> None:
        """A picture of a camera was decoded, or could not be; three in a row are missing."""
        self._judge(name, "decoding", "" if readable else "its pictures cannot be decoded")

    def compare(self, name: str, whose: str) -> None:
        """A picture of a camera was its own (`whose` is empty), or another camera's."""
        self._judge(name, "comparing", f"it shows the pictures of {whose}" if whose else "")

    def _judge(self, name: str, by: str, trouble: str) -> None:
        one = self._cameras[name]
        with self._lock:
            one.spoiled[by] = one.spoiled[by] + 1 if trouble else 0
            if one.spoiled[by] >= _MISSING:
                one.trouble = trouble
                self._miss(name, one)

    def look(self) -> list[Outage]:
        """What has changed since the last look: outages that began, and those that ended."""
        now, changed = self._clock(), list[Outage]()
        with self._lock:
            for name, one in self._cameras.items():
                if now - one.heard_s > _MISSING * one.period_s + _GRACE_S:
                    self._miss(name, one)
                if one.outage is not None and not one.reported:
                    one.reported = True
                    changed.append(one.outage)
                if one.outage is not None and one.heard_s - one.back_s > _STEADY_S:
                    changed.append(self._end(one.outage, one))
        return changed

    def _miss(self, name: str, one: _Attendance) -> None:
        """Begin an outage, or let the present one go on."""
        if one.outage is None:
            since_s = self._begun_s if math.isnan(one.time_s) else one.time_s
            one.outage, one.reported = _explained(Outage(name, since_s), one), False
        one.back_s = math.inf

    def _end(self, outage: Outage, one: _Attendance) -> Outage:
        over = replace(_explained(outage, one), until_s=one.back_time_s)
        one.past.append(over)
        one.outage, one.back_s, one.trouble = None, math.inf, ""
        return over


def _explained(outage: Outage, one: _Attendance) -> Outage:
    return replace(outage, reason=one.trouble) if one.trouble else outage
