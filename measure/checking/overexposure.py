"""Images that spoil detection: overexposed balls, whose edges shift outwards, and no colour."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from measure.arrays import Bools, Bytes
from measure.checking.finding import Finding, Level
from measure.model import Detection, FrameSet
from measure.model.frames import FULL

_MAX_SATURATED_SHARE = 0.1  # Of a ball's pixels: highlights of lamps and windows have less
_MIN_FRAME_SHARE = 0.5
_PIXEL_STEP = 8
_MAX_CHANNEL_DIFFERENCE = 3
"""Levels between channels of a grey image, by rounding in JPEG; in colour, noise exceeds it."""


class OverexposedCount:
    """Counts overexposed balls."""

    def __init__(self) -> None:
        self._seen = Counter[tuple[str, str]]()
        self._overexposed = Counter[tuple[str, str]]()

    def add(self, frame_set: FrameSet, balls: Sequence[Detection]) -> None:
        """Count the balls found in a frame set."""
        for ball in balls:
            key = ball.camera, ball.ball
            full = _saturated(frame_set.images[ball.camera].pixels, ball)
            self._seen[key] += 1
            self._overexposed[key] += full.size > 0 and full.mean() > _MAX_SATURATED_SHARE

    def findings(self) -> list[Finding]:
        """One line for each camera that sees a ball overexposed in half of its images or more."""
        bright: dict[str, list[str]] = {}
        for (camera, ball), count in self._overexposed.items():
            if count >= _MIN_FRAME_SHARE * self._seen[camera, ball]:
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


def _saturated(pixels: Bytes, ball: Detection) -> Bools:
    """Whether a channel is saturated (n,) in each pixel inside a ball's outline."""
    (x, y), r = ball.center_px.tolist(), ball.radius_px
    top, left = max(math.floor(y - r), 0), max(math.floor(x - r), 0)
    part = pixels[top : math.ceil(y + r) + 1, left : math.ceil(x + r) + 1]
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    inside = (rows + top - y) ** 2 + (columns + left - x) ** 2 < r**2
    return np.asarray(part.max(axis=2) >= FULL)[inside]


class ColorlessCount:
    """Counts images without colour."""

    def __init__(self) -> None:
        self._seen, self._colorless = Counter[str](), Counter[str]()

    def add(self, frame_set: FrameSet) -> None:
        """Compare the channels of each camera's picture."""
        for name, image in frame_set.images.items():
            some = np.asarray(image.pixels)[::_PIXEL_STEP, ::_PIXEL_STEP].astype(np.int16)
            grey = bool(np.ptp(some, axis=2).max() <= _MAX_CHANNEL_DIFFERENCE)
            self._seen[name] += 1
            self._colorless[name] += grey

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
