"""A camera's own clock, brought to ours."""

from __future__ import annotations

from collections import deque

_WINDOW_S = 30.0
"""Delays older than this are dropped: clocks drift by tens of microseconds a second."""
_JUMP_S = 1.0  # A clock that is off by so much more than before has been set anew
_HELD_UP_S = 5.0  # Pictures that are later than that for a shorter time were held up by the network
_MAX_RESTARTED_SHARE = 0.1
"""Share of pictures at which a clock may be set anew; one that stands still, or does not count
seconds, is at every picture."""


class DeviceClock:
    """When pictures were taken, from when they arrived and what the camera's clock says.

    A camera's clock runs evenly, but from a start of its own; pictures arrive on our clock, but
    late by what it takes to read them out, compress and send them, which varies. The least delay of
    late ties one to the other (as in the clock filter of RFC 5905). What every picture takes at
    least stays: a constant, of which cameras of one kind have about the same; `measure refine`
    finds by how much they differ.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()
        self._start_s = self._last_s = 0.0
        self._late_since_s: float | None = None
        self._stamps = self._anew = 0

    @property
    def runs(self) -> bool:
        """Whether times are the camera's: it has a clock, and that runs as ours does."""
        return self._stamps > 0 and self._anew <= _MAX_RESTARTED_SHARE * self._stamps

    def time_s(self, arrived_s: float, device_s: float | None) -> float:
        """The time of a picture, s on our clock.

        Args:
            arrived_s: when it had arrived, on our clock.
            device_s: its stamp on the camera's clock; without one it is taken when it arrived.
        """
        if device_s is None:
            return arrived_s
        self._stamps += 1
        since_s, least = device_s - self._start_s, self._least
        late = arrived_s - since_s
        if not least or since_s <= self._last_s or self._is_set_anew(arrived_s, late):
            self._anew += bool(least)
            least.clear()
            # From here on, for whatever clocks count from would cost digits.
            self._start_s, since_s, late, self._late_since_s = device_s, 0.0, arrived_s, None
        self._last_s = since_s
        while least and least[-1][1] >= late:
            least.pop()
        least.append((since_s, late))
        while least[0][0] < since_s - _WINDOW_S:
            least.popleft()
        return since_s + least[0][1]

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
