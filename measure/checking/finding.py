"""One result of a check."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad it is."""

    WRONG = "wrong"
    WEAK = "weak"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One line of a check.

    Attributes:
        level: WRONG spoils results; WEAK costs accuracy; NOTE is worth knowing.
        topic: "balls", "body", "calibration", "clock", "colour", "coverage", "exposure", "frames".
        text: what, where, how much, and what to do.
    """

    level: Level
    topic: str
    text: str
