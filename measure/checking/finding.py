"""One result of a check or of the judgement of a calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from measure.model.doubts import Doubt


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
    text: str  # what, where, how much, and what to do; a `Doubt` has its code
    camera: str = ""  # the camera it concerns, where `text` does not name it; empty for all
    # of a cause: its word, as on the page of what can go wrong; else the text's, or the topic.
    code: str = ""
    subject: str = ""  # the cameras or balls concerned, parted by ", ", or "all"
    estimate: float | None = None  # how much, in `unit`
    sd: float | None = None  # its standard deviation
    unit: str = ""
    since_s: float | None = None  # from when on; None: from the start, or not known
    rivals: tuple[str, ...] = ()  # what explains as much, as "clock of cam1"
    remedy: str = ""  # what mends it, where `text` does not say it

    def __post_init__(self) -> None:
        code = self.text.code if isinstance(self.text, Doubt) else self.topic
        object.__setattr__(self, "code", self.code or code)
        object.__setattr__(self, "subject", self.subject or self.camera)

    def __str__(self) -> str:
        where = f"camera {self.camera}: " if self.camera else ""
        return f"{self.level}: {where}{self.text}"


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by level, in their order within a level."""
    levels = list(Level)
    return tuple(sorted(findings, key=lambda finding: levels.index(finding.level)))
