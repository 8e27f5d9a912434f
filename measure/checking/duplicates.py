"""Pictures that a stalled camera or driver handed out again, with a new stamp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Floats, Ints
from measure.checking.finding import Finding, Level
from measure.measuring.duplicate_images import Repeats
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


_DROPPED = 1.5
_UNEVEN = 0.1
_MOST_DROPPED = 0.02
_SLOWEST_S = 10.0
"""Pictures further apart are rather stamped in milliseconds than taken by hand."""


def stamp_findings(camera: str, times_s: Floats, frames: Ints) -> list[Finding]:
    """Look at one camera's time stamps.

    Args:
        camera: its name.
        times_s: (n,) stamps, increasing.
        frames: (n,) frame numbers.
    """
    if len(times_s) < 3:
        return [Finding(Level.WEAK, "frames", f"{camera}: only {len(times_s)} frames")]
    steps = np.diff(times_s)
    period = float(np.median(steps))
    gaps = np.nonzero(steps > _DROPPED * period)[0]
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1))
    out = []
    if period > _SLOWEST_S:
        text = f"{camera}: {period:.1f} s from picture to picture: are the times milliseconds?"
        out.append(Finding(Level.WEAK, "clock", f"{text} Write seconds"))
    if lost:
        worst = int(gaps[np.argmax(steps[gaps])])
        share = lost / (len(times_s) + lost)
        out.append(
            Finding(
                Level.WEAK if share > _MOST_DROPPED else Level.NOTE,
                "frames",
                f"{camera}: {lost} frames dropped ({100 * share:.1f} %), the longest gap "
                f"{steps[worst]:.3f} s after frame {frames[worst]} at {times_s[worst]:.3f} s",
            )
        )
    even = np.delete(steps, gaps)
    jitter = float(np.std(even - np.median(even)))
    if jitter > _UNEVEN * period:
        out.append(
            Finding(
                Level.WEAK,
                "clock",
                f"{camera}: stamps {1e3 * jitter:.1f} ms uneven about {1e3 * period:.1f} ms: "
                "are they the middles of the exposures, or arrival times?",
            )
        )
    return out


_NAMED = 8


def damage_findings(camera: str, frames: Sequence[int], count: int) -> list[Finding]:
    """One line if pictures are damaged.

    Args:
        camera: its name.
        frames: the numbers of those that are.
        count: how many pictures were looked at.
    """
    if not frames:
        return []
    named = ", ".join(map(str, frames[:_NAMED])) + (", ..." if len(frames) > _NAMED else "")
    which = "frames" if len(frames) > 1 else "frame"
    text = (
        f"{camera}: {len(frames)} of {count} pictures are damaged ({which} {named}): a part is "
        "missing, and what decodes in its place is grey or shifted; copy them again from where "
        "they were recorded, or remove the files, and their frames count as missing"
    )
    return [Finding(Level.WRONG, "frames", text)]
