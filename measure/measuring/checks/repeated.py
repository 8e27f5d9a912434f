"""Pictures that a stalled camera or driver handed out again, with a new stamp."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.measuring.checks.finding import Finding, Level
from measure.measuring.repeats import Repeats
from measure.model import FrameSet

_FEW, _MOST = 0.02, 0.5


class RepeatCount:
    """Counts repeats among the pictures that pass by, for recordings that tell them no other way.

    Attributes:
        looked_at: frame numbers by camera.
        repeated: those of pictures that repeat the one that passed before, by camera.
    """

    def __init__(self) -> None:
        self._repeats = Repeats()
        self.looked_at: dict[str, set[int]] = {}
        self.repeated: dict[str, set[int]] = {}

    def look(self, frame_set: FrameSet) -> None:
        """Compare each camera's picture with its last one."""
        for name, image in frame_set.images.items():
            self.looked_at.setdefault(name, set()).add(image.frame)
        for name in self._repeats.repeated(frame_set):
            self.repeated.setdefault(name, set()).add(frame_set.images[name].frame)


def repeat_findings(
    camera: str, repeated: Ints, looked_at: int, times_s: Floats, frames: Ints
) -> list[Finding]:
    """One line if pictures repeat the one before them.

    Args:
        camera: its name.
        repeated: (k,) positions of the pictures that do, increasing.
        looked_at: how many pictures were compared with the one before.
        times_s: (n,) stamps of all pictures.
        frames: (n,) frame numbers of all pictures.
    """
    if not len(repeated):
        return []
    share = len(repeated) / max(looked_at, 1)
    runs = np.split(repeated, np.nonzero(np.diff(repeated) > 1)[0] + 1)
    longest = max(runs, key=len)
    level = Level.NOTE if share <= _FEW else Level.WEAK if share <= _MOST else Level.WRONG
    text = (
        f"{camera}: {len(repeated)} of {looked_at} pictures repeat the one before "
        f"({100 * share:.1f} %), at most {len(longest)} in a row, from frame "
        f"{frames[longest[0]]} at {times_s[longest[0]]:.3f} s: the camera or its driver stalled; "
        "they are not measured; record at a lower rate, or mend its cable or power"
    )
    return [Finding(level, "frames", text)]
