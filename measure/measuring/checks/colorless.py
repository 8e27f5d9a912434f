"""Pictures without colour, in which no coloured ball can be told."""

from __future__ import annotations

import numpy as np

from measure.measuring.checks.finding import Finding, Level
from measure.model import FrameSet

_EVERY = 8
_MOST_APART = 3
"""Levels by which the channels of a grey picture differ at most: a JPEG of one rounds them apart.
Those of a colour camera differ by more, by noise alone."""


class ColorlessCount:
    """Counts pictures without colour among those that pass by."""

    def __init__(self) -> None:
        self._seen: dict[str, int] = {}
        self._colorless: dict[str, int] = {}

    def look(self, frame_set: FrameSet) -> None:
        """Compare the channels of each camera's picture."""
        for name, image in frame_set.images.items():
            some = np.asarray(image.pixels)[::_EVERY, ::_EVERY].astype(np.int16)
            grey = bool(np.ptp(some, axis=2).max() <= _MOST_APART)
            self._seen[name] = self._seen.get(name, 0) + 1
            self._colorless[name] = self._colorless.get(name, 0) + grey

    def findings(self) -> list[Finding]:
        """One line for each camera whose pictures have no colour."""
        return [
            Finding(
                Level.WRONG,
                "colour",
                f"{name}: {grey} of {self._seen[name]} pictures are grey: balls are told by their "
                "colours, so this camera sees none; record in colour",
            )
            for name, grey in self._colorless.items()
            if grey
        ]
