"""Images with their own times, and the sets of them that belong to one instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

from measure.arrays import Bytes

FULL = 250
"""Picture values from here on may be clipped: JPEG moves them by some levels."""


@dataclass(frozen=True, eq=False)
class Image:
    """One camera's picture."""

    camera: str  # the camera's name
    frame: int  # its number in that camera's recording
    time_s: float  # the middle of its exposure, on the session's clock
    # returns the pixels, BGR (h, w, 3) uint8; called once, maybe in another thread, and
    # again only if they are used after `release`.
    decode: Callable[[], Bytes]
    # the original JPEG bytes where there are any (for the viewer), else None.
    encoded: bytes | None = None
    time_sd_s: float = 0.0  # standard deviation of `time_s`, where its stamps show one
    _turn: Lock = field(default_factory=Lock, init=False, repr=False)
    _decoded: list[Bytes] = field(default_factory=list, init=False, repr=False)

    @property
    def pixels(self) -> Bytes:
        """BGR pixels (h, w, 3), decoded on first use."""
        # Not a `cached_property`: before Python 3.12 all instances share its lock, so that only
        # one thread of all would decode.
        with self._turn:
            if not self._decoded:
                self._decoded.append(self.decode())
            return self._decoded[0]

    def release(self) -> None:
        """Let go of the pixels, where they can be decoded again."""
        if self.encoded is not None:
            with self._turn:
                self._decoded.clear()


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The images of all cameras that belong to one instant; a camera without one is left out."""

    index: int  # number of the set in the session
    time_s: float  # the instant
    images: dict[str, Image]  # by camera name
