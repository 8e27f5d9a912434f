"""What may be wrong with a recording, in the words of docs/explanation/what_can_go_wrong.md."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from measure.checking.finding import Finding, Level


class Word(StrEnum):
    """A cause."""

    CLOCK = "clock"
    CLOCK_STEP = "clock-step"
    MOVED = "moved"
    MOVED_AT = "moved-at"
    DRIFT = "drift"
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
    BLURRED = "blurred"
    ROLLING = "rolling"
    UNKNOWN = "unknown"


NAMED_SIGMAS, WRONG_SIGMAS = 3.0, 6.0
"""Standard deviations by which an estimate differs from a rig that is right: of fewer it is no
cause, and of fewer than the latter it is weak at most."""
MEND = "`measure mend SESSION -o MENDED`"
"""The command that takes a cause out of a copy."""
ALL = "all"
"""What a cause concerns that concerns all cameras or balls."""
BY_HAND = (
    Word.SAME_PICTURES, Word.REPEATED, Word.EXPOSURE, Word.INTERLACED, Word.BLURRED, Word.UNKNOWN,
    Word.DRIFT,
)  # fmt: skip
"""What is wrong with pictures themselves, or changes all the time: no other calibration, body or
stamps mend it."""
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
    Word.BLURRED: "frames",
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
    nothing: float = 0.0  # the estimate where nothing is off
    explains: float = 1.0  # share of what the recording shows against the rig as stated
    # what else explains it as well, as "clock of cam1".
    rivals: tuple[str, ...] = ()
    since_s: float | None = None  # from when on, if not from the start
    # what is exchanged with what, or how pictures are stored, by camera or ball.
    instead: Mapping[str, str] = field(default_factory=dict)

    @property
    def mendable(self) -> bool:
        """Whether `measure mend` can take it out of a copy of calibration, body and stamps.

        Not if it is open which of two cameras is off, or which sign of a body file is wrong.
        """
        named = self.cause is not Word.MIRRORED or bool(self.instead)
        one = "," not in self.of or self.cause not in (Word.MOVED, Word.MOVED_AT)
        return named and one and self.cause not in BY_HAND

    @property
    def deviations(self) -> float:
        """By how many of its standard deviations it is off; infinite where it is no estimate."""
        if self.estimate is None or self.sd is None:
            return math.inf
        return abs(self.estimate - self.nothing) / max(self.sd, 1e-12)

    @property
    def finding(self) -> Finding:
        """The line of a check."""
        text = f"{self.text}{rivals_text(self.rivals)}: {self.remedy}"
        remedy = f"{self.remedy}; or {MEND}" if self.mendable else self.remedy
        return Finding(
            self.level,
            TOPICS.get(self.cause, "calibration"),
            text,
            code=str(self.cause),
            subject=self.of,
            estimate=self.estimate,
            sd=self.sd,
            unit=self.unit,
            since_s=self.since_s,
            rivals=self.rivals,
            remedy=remedy,
        )


def significant(causes: Iterable[Cause]) -> list[Cause]:
    """Those that are not chance by what they state of themselves; the less certain are weak."""
    weak = {Level.WRONG: Level.WEAK}
    return [
        c if c.deviations >= WRONG_SIGMAS else replace(c, level=weak.get(c.level, c.level))
        for c in causes
        if c.deviations >= NAMED_SIGMAS
    ]


def beside(pictures: Sequence[Cause], others: Sequence[Cause]) -> list[Cause]:
    """Pictures that are not what they seem, and what else is off.

    What they show of clocks and places is no cause, and neither is what may be chance.
    """
    said = {name for cause in pictures for name in cause.of.split(", ")}
    rest = (c for c in others if ALL not in said and c.of not in said)
    return significant([*pictures, *rest])


def with_weak(causes: Sequence[Cause], weak: Sequence[Cause]) -> list[Cause]:
    """Causes; where none is certain, first what pictures show that costs accuracy."""
    first = bool(causes) and causes[0].level is Level.WRONG
    return [*causes, *weak] if first else [*weak, *causes]


def rivals_text(rivals: tuple[str, ...]) -> str:
    """The causes that remain possible, for the middle of a line; empty if none."""
    if not rivals:
        return ""
    each = [in_words(*rival.split(" of ", 1)) for rival in rivals]
    return f", or {', or '.join(each)} (this recording cannot tell which)"


def in_words(word: str, of: str) -> str:
    """A rival's code and what it concerns."""
    own, every = _RIVALS.get(Word(word), (f"{word} of {{of}}", f"{word} of all"))
    return every if of == ALL else own.format(of=of)


_RIVALS = {
    Word.CLOCK: ("the clock of {of} is off", "all clocks are off"),
    Word.CLOCK_STEP: ("the clock of {of} steps", "all clocks step"),
    Word.MOVED: ("{of} was moved", "all cameras were moved"),
    Word.MOVED_AT: ("{of} was moved midway", "all cameras were moved midway"),
    Word.DRIFT: ("{of} drifts", "all cameras drift"),
    Word.ZOOM: ("{of} was zoomed or focused", "all cameras were zoomed or focused"),
    Word.POINT: (
        "the principal point of {of} is off",
        "the principal points of all cameras are off",
    ),
    Word.SCALE: ("the scale of {of} is off", "the scale of the calibration is off"),
    Word.SQUARE: ("the board of {of} is off", "the printed board's square was measured wrong"),
    Word.RADIUS: ("ball {of} has another radius", "all balls have another radius"),
    Word.PLACE: (
        "ball {of} is elsewhere on the body",
        "the balls are nearer together or further apart than the body file says",
    ),
    Word.EXCHANGED_BALLS: (
        "the colours of {of} are exchanged in the body file",
        "all colours are exchanged in the body file",
    ),
    Word.MIRRORED: ("the {of} file is mirrored", "all pictures are mirrored"),
    Word.ROLLING: ("the shutter of {of} rolls", "all shutters roll"),
}
"""Causes that may be rivals, of one camera or ball, and of all."""
