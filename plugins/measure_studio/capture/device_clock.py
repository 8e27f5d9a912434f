"""A camera's own clock, brought to ours."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np

from measure.arrays import Floats
from measure_studio.capture.sources import RECENT

_WINDOW_S = 30.0
"""Delays older than this are dropped: clocks drift by tens of microseconds a second."""
_JUMP_S = 1.0  # A clock that is off by so much more than before has been set anew
_HELD_UP_S = 5.0  # Pictures that are later than that for a shorter time were held up by the network
_MAX_RESTARTED_SHARE = 0.1
"""Share of pictures at which a clock may be set anew; one that stands still, or does not count
seconds, is at every picture."""


class Arrivals:
    """How late pictures arrive, against the rate of their camera: of late, the least late are not.

    A camera exposes evenly, so that what its pictures are off an even row is the network's or a
    busy machine's. One that changes its rate is taken to be late until the new rate is known.
    """

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=RECENT)

    def add(self, arrived_s: float) -> None:
        """A picture arrived."""
        self._at_s.append(arrived_s)

    def lateness_s(self) -> Floats:
        """(n,) of the latest pictures, oldest first; zeros as long as there are too few."""
        steps = np.diff(self._at_s)
        period_s = float(np.median(steps)) if len(steps) else 0.0
        if len(steps) < 2 or period_s <= 0:
            return np.zeros(len(self._at_s))
        numbers = np.concatenate([[0.0], np.cumsum(_periods(steps / period_s))])
        off_s = np.array(self._at_s) - self._at_s[0] - period_s * numbers
        # The median step is off by its error; medians of both halves show by how much, whatever
        # some late ones do.
        half = len(off_s) // 2
        rise_s = np.median(off_s[half:]) - np.median(off_s[:half])
        off_s -= numbers * rise_s / (numbers[half:].mean() - numbers[:half].mean())
        return off_s - off_s.min()


def _periods(steps: Floats) -> Floats:
    """How many periods of their camera (n,) lie between pictures that arrived so many (n,) apart.

    What was held up arrives with those that follow it, after which no picture is missing. The last
    long step may be either: until it is known, its picture is taken to be late.
    """
    out = np.ones(len(steps))
    firsts = np.flatnonzero(steps >= 0.5)  # the others came at once after the one before them
    for first, end in pairwise(firsts):
        missing = np.rint(steps[first:end].sum()) - (end - first)
        out[first] += max(missing, 0.0)
    return out


class DeviceClock:
    """When pictures were taken, from when they arrived and what the camera's clock says.

    A camera's clock runs evenly, but from a start of its own; pictures arrive on our clock, but
    late by what it takes to read them out, compress and send them, which varies. The least delay of
    late ties one to the other (as in the clock filter of RFC 5905). What every picture takes at
    least stays: a constant, about the same for cameras of one kind; `measure refine`
    finds by how much they differ.

    Attributes:
        sd_s: standard deviation of the last reported time: what its picture is late against
            the camera's rate, if it is the time of arrival, and at least what is usual; with a
            clock that was just set anew, what the least late one since was.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()
        self._start_s = self._last_s = 0.0
        self._late_since_s: float | None = None
        self._stamps = self._anew = 0
        self._arrivals, self._tied_sd_s, self.sd_s = Arrivals(), 0.0, 0.0

    @property
    def runs(self) -> bool:
        """Whether times of stamps are the camera's: its clock runs as ours does."""
        return self._stamps > 0 and self._anew <= _MAX_RESTARTED_SHARE * self._stamps

    def time_s(self, arrived_s: float, device_s: float | None) -> float:
        """The time of a picture, s on our clock.

        Args:
            arrived_s: when it had arrived, on our clock.
            device_s: its stamp on the camera's clock; without one it is taken when it arrived.
        """
        self._arrivals.add(arrived_s)
        if device_s is None:
            self.sd_s = self._arrival_sd_s()
            return arrived_s
        self._stamps += 1
        since_s, least = device_s - self._start_s, self._least
        late = arrived_s - since_s
        if not least or since_s <= self._last_s or self._is_set_anew(arrived_s, late):
            self._anew += bool(least)
            least.clear()
            # From here on, for whatever clocks count from would cost digits.
            self._start_s, since_s, late, self._late_since_s = device_s, 0.0, arrived_s, None
            self._tied_sd_s = math.inf
        self._last_s = since_s
        while least and least[-1][1] >= late:
            least.pop()
        least.append((since_s, late))
        while least[0][0] < since_s - _WINDOW_S:
            least.popleft()
        if self._tied_sd_s:
            self._tied_sd_s = min(self._tied_sd_s, float(self._arrivals.lateness_s()[-1]))
        self.sd_s = self._tied_sd_s if self.runs else self._arrival_sd_s()
        return since_s + least[0][1]

    def _arrival_sd_s(self) -> float:
        lateness_s = self._arrivals.lateness_s()
        return float(max(lateness_s[-1], np.median(lateness_s)))

    def _is_set_anew(self, arrived_s: float, late: float) -> bool:
        """Whether the clock was set: at once where it is ahead, after a while where it is behind.

        What a network holds up seems behind too, but only until it has all come.
        """
        behind = late - self._least[0][1]
        if behind <= _JUMP_S:
            self._late_since_s = None
            return behind < -_JUMP_S
        if self._late_since_s is None:
            self._late_since_s = arrived_s
        return arrived_s - self._late_since_s > _HELD_UP_S
