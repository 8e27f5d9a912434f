"""What may be wrong with a recording, in the words of docs/explanation/what_can_go_wrong.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from measure.checking.finding import Finding, Level


class Word(StrEnum):
    """A cause."""

    CLOCK = "clock"
    CLOCK_STEP = "clock-step"
    MOVED = "moved"
    MOVED_AT = "moved-at"
    ZOOM = "zoom"
    POINT = "principal-point"
    MIRRORED = "mirrored"
    SCALE = "scale"
    SQUARE = "board-square"
    RADIUS = "radius"
    PLACE = "ball-place"
    EXCHANGED_BALLS = "exchanged-balls"
    EXCHANGED_CAMERAS = "exchanged-cameras"
    EXCHANGED_CHANNELS = "exchanged-channels"
    SAME_PICTURES = "same-pictures"
    REPEATED = "repeated-pictures"
    EXPOSURE = "exposure"
    INTERLACED = "interlaced"
    ROLLING = "rolling"
    UNKNOWN = "unknown"


ALL = "all"
"""What a cause concerns that concerns all cameras or balls."""
TOPICS = {
    Word.CLOCK: "clock",
    Word.CLOCK_STEP: "clock",
    Word.ROLLING: "clock",
    Word.RADIUS: "body",
    Word.PLACE: "body",
    Word.SCALE: "body",
    Word.SQUARE: "body",
    Word.EXCHANGED_BALLS: "body",
    Word.EXCHANGED_CAMERAS: "cameras",
    Word.MIRRORED: "cameras",
    Word.EXCHANGED_CHANNELS: "colour",
    Word.SAME_PICTURES: "frames",
    Word.REPEATED: "frames",
    Word.EXPOSURE: "exposure",
    Word.INTERLACED: "frames",
}
"""Of a finding; "calibration" for all others."""


@dataclass(frozen=True)
class Cause:
    """One cause of what a recording shows."""

    cause: Word
    of: str  # the cameras or balls concerned, parted by ", ", or `ALL`
    text: str  # what, how much, and how that is known
    remedy: str  # what mends it
    level: Level
    estimate: float | None = None  # how much, in `unit`
    sd: float | None = None  # its standard deviation
    unit: str = ""
    explains: float = 1.0  # share of what the recording shows against the rig as stated
    # what else explains it as well, as "clock of cam1".
    rivals: tuple[str, ...] = ()

    @property
    def finding(self) -> Finding:
        """The line of a check."""
        text = f"{self.text}{rivals_text(self.rivals)}: {self.remedy}"
        return Finding(self.level, TOPICS.get(self.cause, "calibration"), text)


def beside(pictures: Sequence[Cause], others: Sequence[Cause]) -> list[Cause]:
    """Pictures that are not what they seem, and what else is off.

    What they show of clocks and places is no cause.
    """
    said = {name for cause in pictures for name in cause.of.split(", ")}
    return [*pictures, *(c for c in others if ALL not in said and c.of not in said)]


def with_weak(causes: Sequence[Cause], weak: Sequence[Cause]) -> list[Cause]:
    """Causes, and before those of which none is certain what pictures show that costs accuracy."""
    first = bool(causes) and causes[0].level is Level.WRONG
    return [*causes, *weak] if first else [*weak, *causes]


def rivals_text(rivals: tuple[str, ...]) -> str:
    """What cannot be told apart, for the middle of a line; empty if nothing is."""
    if not rivals:
        return ""
    return f" (this motion cannot tell it from {', '.join(rivals)})"
