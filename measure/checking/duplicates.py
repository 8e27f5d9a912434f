"""Findings on the frames of a camera: duplicates, dropped frames, uneven stamps, damage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Floats, Ints
from measure.checking.finding import Finding, Level
from measure.measuring.duplicate_images import DuplicateImages
from measure.model import FrameSet
from measure.session.timestamps import StampErrors

_NOTE_SHARE, _WEAK_SHARE = 0.02, 0.5
"""Largest shares of duplicates that are only noted, and that only weaken the results."""
_DROPPED_STEPS = 1.5  # A gap longer than this, in periods, has dropped frames
_MAX_DROPPED_SHARE = 0.02
_MAX_FRAMES_NAMED = 8


class DuplicateCount:
    """Counts duplicates among decoded images, for recordings whose files do not show them.

    Attributes:
        compared: frame numbers by camera.
        repeated: those of images that are the same as the one before, by camera.
    """

    def __init__(self) -> None:
        self._duplicates = DuplicateImages()
        self.compared: dict[str, set[int]] = {}
        self.repeated: dict[str, set[int]] = {}

    def add(self, frame_set: FrameSet) -> None:
        """Compare each camera's picture with its last one."""
        for name, image in frame_set.images.items():
            self.compared.setdefault(name, set()).add(image.frame)
        for name in self._duplicates.of(frame_set):
            self.repeated.setdefault(name, set()).add(frame_set.images[name].frame)


def duplicate_findings(
    camera: str, repeated: Ints, compared: int, times_s: Floats, frames: Ints
) -> list[Finding]:
    """One line if images are the same as the one before.

    Args:
        repeated: (k,) positions of the duplicates, increasing.
        compared: number of images compared with the one before.
        times_s: (n,) stamps of all images.
        frames: (n,) frame numbers of all images.
    """
    if not len(repeated):
        return []
    share = len(repeated) / max(compared, 1)
    runs = np.split(repeated, np.nonzero(np.diff(repeated) > 1)[0] + 1)
    longest = max(runs, key=len)
    level = Level.WRONG if share > _WEAK_SHARE else Level.WEAK
    level = Level.NOTE if share <= _NOTE_SHARE else level
    text = (
        f"{camera}: {len(repeated)} of {compared} pictures repeat the one before "
        f"({100 * share:.1f} %), at most {len(longest)} in a row, from frame "
        f"{frames[longest[0]]} at {times_s[longest[0]]:.3f} s: the camera or its driver stalled; "
        "they are not measured; record at a lower rate, or mend its cable or power"
    )
    return [Finding(level, "frames", text)]


def stamp_findings(camera: str, times_s: Floats, frames: Ints) -> list[Finding]:
    """Dropped frames, uneven stamps (n,), which increase, and wrong units of one camera."""
    if len(times_s) < 3:
        return [Finding(Level.WEAK, "frames", f"{camera}: only {len(times_s)} frames")]
    steps = np.diff(times_s)
    period = float(np.median(steps))
    gaps = np.nonzero(steps > _DROPPED_STEPS * period)[0]
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1))
    notes = StampErrors.of(times_s).notes
    out = [Finding(Level.WEAK, "clock", f"{camera}: {note}") for note in notes]
    if lost:
        worst = int(gaps[np.argmax(steps[gaps])])
        share = lost / (len(times_s) + lost)
        out.append(
            Finding(
                Level.WEAK if share > _MAX_DROPPED_SHARE else Level.NOTE,
                "frames",
                f"{camera}: {lost} frames dropped ({100 * share:.1f} %), the longest gap "
                f"{steps[worst]:.3f} s after frame {frames[worst]} at {times_s[worst]:.3f} s",
            )
        )
    return out


def damage_findings(camera: str, frames: Sequence[int], count: int) -> list[Finding]:
    """One line if images, of `count` examined, are damaged: `frames` are their numbers."""
    if not frames:
        return []
    named = ", ".join(map(str, frames[:_MAX_FRAMES_NAMED])) + (
        ", ..." if len(frames) > _MAX_FRAMES_NAMED else ""
    )
    which = "frames" if len(frames) > 1 else "frame"
    text = (
        f"{camera}: {len(frames)} of {count} pictures are damaged ({which} {named}): a part is "
        "missing, and what decodes in its place is grey or shifted; copy them again from where "
        "they were recorded, or remove the files, and their frames count as missing"
    )
    return [Finding(Level.WRONG, "frames", text)]
