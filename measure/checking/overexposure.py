"""Balls so bright that the sensor is full: their edges show further out than they are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from measure.arrays import Bools, Bytes
from measure.checking.finding import Finding, Level
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
