"""Balls so bright that the sensor is full: their edges show further out than they are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from measure.arrays import Bools, Bytes
from measure.measuring.checks.finding import Finding, Level
from measure.model import Detection, FrameSet
from measure.model.frames import FULL

_MUCH = 0.1
"""Share of a ball: highlights of lamps and windows have less."""
_OFTEN = 0.5


class OverexposedCount:
    """Counts balls that are overexposed among those that pass by."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], int] = {}
        self._full: dict[tuple[str, str], int] = {}

    def look(self, frame_set: FrameSet, balls: Sequence[Detection]) -> None:
        """Look at the balls that were found in a frame set."""
        for ball in balls:
            key = ball.camera, ball.ball
            full = _full(frame_set.images[ball.camera].pixels, ball)
            self._seen[key] = self._seen.get(key, 0) + 1
            self._full[key] = self._full.get(key, 0) + (full.size > 0 and full.mean() > _MUCH)

    def findings(self) -> list[Finding]:
        """One line for each camera before which balls are overexposed half the time or more."""
        bright: dict[str, list[str]] = {}
        for (camera, ball), count in self._full.items():
            if count >= _OFTEN * self._seen[camera, ball]:
                bright.setdefault(camera, []).append(
                    f"{ball} in {count} of {self._seen[camera, ball]}"
                )
        return [
            Finding(
                Level.WEAK,
                "exposure",
                f"{camera}: balls are overexposed ({', '.join(balls)} pictures): their edges show "
                "up to half a pixel further out than they are; expose for less time",
            )
            for camera, balls in bright.items()
        ]


def _full(pixels: Bytes, ball: Detection) -> Bools:
    """Of the pixels inside a ball's outline, whether a colour is full (n,)."""
    (x, y), r = ball.center_px.tolist(), ball.radius_px
    top, left = max(math.floor(y - r), 0), max(math.floor(x - r), 0)
    part = pixels[top : math.ceil(y + r) + 1, left : math.ceil(x + r) + 1]
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    inside = (rows + top - y) ** 2 + (columns + left - x) ** 2 < r**2
    return np.asarray(part.max(axis=2) >= FULL)[inside]
