"""One camera's recording, whatever it is kept in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.errors import SessionError
from measure.model import Image
from measure.session.stamp_errors import StampErrors


class Stream(ABC):
    """The frames of one camera, in the order of their times.

    Attributes:
        source: the folder, glob or video file, for messages.
        size_wh: width and height of its images in px.
        frames: (n,) frame numbers.
        times_s: (n,) middles of the exposures on the session's clock, increasing.
        stamps: how wrong the times are, as far as they show it.
        notes: what a user should know: missing frames and the like.
    """

    def __init__(
        self,
        name: str,
        source: str,
        size_wh: tuple[int, int],
        frames: Ints,
        times_s: Floats,
        files: Sequence[Path],
        notes: tuple[str, ...] = (),
    ) -> None:
        self.name = name
        self.source = source
        self.size_wh = size_wh
        self.frames = frames
        self.times_s = times_s
        self.files = list(files)
        self.stamps = StampErrors.of(times_s)
        self.notes = notes

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def period_s(self) -> float:
        """Median time between frames; infinite for a single one."""
        return float(np.median(np.diff(self.times_s))) if len(self) > 1 else float("inf")

    @abstractmethod
    def read(self, index: int) -> Image:
        """The frame at position `index`, decoded on first use; SessionError says which it is."""

    def repeated(self) -> Ints | None:
        """Positions of pictures equal to the one before; None where only decoding would show it."""
        return None

    def close(self) -> None:  # noqa: B027 -- most streams hold nothing open
        """Let go of open files."""

    def _image(self, index: int, decode: Callable[[], Bytes], encoded: bytes | None) -> Image:
        frame, time_s = int(self.frames[index]), float(self.times_s[index])
        return Image(self.name, frame, time_s, decode, encoded, float(self.stamps.sd_s[index]))

    def place(self, index: int) -> str:
        """Camera and frame, for messages."""
        return f"camera '{self.name}', frame {self.frames[index]}"

    def check_index(self, index: int) -> None:
        """Refuse a position outside the recording."""
        if not 0 <= index < len(self):
            raise SessionError(
                f"camera '{self.name}': there is no frame at position {index}; "
                f"{self.source} has {len(self)}"
            )


def turned_notes(name: str, turned: bool) -> tuple[str, ...]:
    """What to say of a camera whose pictures bear a tag that asks to turn them, if they do."""
    text = (
        f"camera '{name}': an orientation tag asks to turn its pictures; they are measured as "
        "stored: calibrate stored ones (measure calibrate does; OpenCV turns what it reads)"
    )
    return (text,) if turned else ()
