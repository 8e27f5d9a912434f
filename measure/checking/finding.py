"""One result of a check or of the judgement of a calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad it is."""

    WRONG = "wrong"
    WEAK = "weak"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One line of a check or of the judgement of a calibration."""

    level: Level  # WRONG spoils results; WEAK costs accuracy; NOTE is worth knowing
    # "balls", "body", "calibration", "cameras", "clock", "colour", "coverage", "exposure",
    # "frames", "poses"; of a calibration "accuracy", "boards", "cameras", "lens", "marks".
    topic: str
    text: str  # what, where, how much, and what to do
    camera: str = ""  # the camera it concerns, where `text` does not name it; empty for all

    def __str__(self) -> str:
        where = f"camera {self.camera}: " if self.camera else ""
        return f"{self.level}: {where}{self.text}"


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by level, in their order within a level."""
    levels = list(Level)
    return tuple(sorted(findings, key=lambda finding: levels.index(finding.level)))
