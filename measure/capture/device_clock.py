"""A camera's own clock, brought to ours."""

from __future__ import annotations

from collections import deque

_WINDOW_S = 30.0
"""Clocks drift by tens of microseconds a second: what is older than this is forgotten."""
_JUMP_S = 1.0
"""A clock that is off by so much more than before has been set anew."""


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
        self._last_s: float | None = None

    def time_s(self, arrived_s: float, device_s: float | None) -> float:
        """The time of a picture, s on our clock.

        Args:
            arrived_s: when it had arrived, on our clock.
            device_s: its stamp on the camera's clock; without one it is taken when it arrived.
        """
        if device_s is None:
            return arrived_s
        late, least = arrived_s - device_s, self._least
        if least and (device_s <= (self._last_s or 0.0) or abs(late - least[0][1]) > _JUMP_S):
            least.clear()
        self._last_s = device_s
        while least and least[-1][1] >= late:
            least.pop()
        least.append((device_s, late))
        while least[0][0] < device_s - _WINDOW_S:
            least.popleft()
        return device_s + least[0][1]
