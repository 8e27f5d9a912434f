"""Images with their own times, and the sets of them that belong to one instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from measure.arrays import Bytes


@dataclass(frozen=True, eq=False)
class Image:
    """One camera's picture.

    Attributes:
        camera: the camera's name.
        frame: its number in that camera's recording.
        time_s: the middle of its exposure, on the session's clock.
        decode: returns the pixels, BGR (h, w, 3) uint8; called at most once, maybe in another
            thread.
        encoded: the original JPEG bytes where there are any (for the viewer), else None.
    """

    camera: str
    frame: int
    time_s: float
    decode: Callable[[], Bytes]
    encoded: bytes | None = None

    @cached_property
    def pixels(self) -> Bytes:
        """BGR pixels (h, w, 3), decoded on first use."""
        return self.decode()


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The images of all cameras that belong to one instant; a camera without one is left out.

    Attributes:
        index: number of the set in the session.
        time_s: the instant.
        images: by camera name.
    """

    index: int
    time_s: float
    images: dict[str, Image]
