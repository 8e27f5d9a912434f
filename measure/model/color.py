"""What colour a ball is: a range in HSV or Lab, learnt from samples or given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bools, Bytes, Floats, floats

ColorSpace = Literal["hsv", "lab"]
_TO_SPACE = {"hsv": cv2.COLOR_BGR2HSV, "lab": cv2.COLOR_BGR2LAB}
HUE_PERIOD = 180
_LEAST_SATURATION = 45
"""Samples whose median saturation (of 255) is lower have no hue worth learning."""


@dataclass(frozen=True)
class ColorRange:
    """A box in OpenCV's 8-bit HSV (hue 0-179, may wrap round) or Lab."""

    space: ColorSpace  # "hsv" or "lab"
    # three lower bounds, inclusive; `low[0] > high[0]` is a hue range across red.
    low: tuple[int, int, int]
    high: tuple[int, int, int]  # three upper bounds, inclusive

    def mask(self, converted: Bytes) -> Bytes:
        """255 where pixels (h, w, 3), already in `space`, lie in the range."""
        if self.low[0] <= self.high[0]:
            return np.asarray(cv2.inRange(converted, self.low, self.high), dtype=np.uint8)
        upper = cv2.inRange(converted, self.low, (255, *self.high[1:]))
        lower = cv2.inRange(converted, (0, *self.low[1:]), self.high)
        return np.asarray(cv2.bitwise_or(upper, lower), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class ConvertedImage:
    """An image with its conversions to colour spaces, each made when first used."""

    bgr: Bytes  # (h, w, 3) pixels
    _known: dict[ColorSpace, Bytes] = field(default_factory=dict)

    def to(self, space: ColorSpace) -> Bytes:
        """The image (h, w, 3) in a colour space."""
        if space not in self._known:
            converted = cv2.cvtColor(self.bgr, _TO_SPACE[space])
            self._known[space] = np.asarray(converted, dtype=np.uint8)
        return self._known[space]


@dataclass(frozen=True)
class BallColor:
    """A ball's colour: any of some ranges."""

    name: str  # as the body file gives it ("green"), or "samples" / "range"
    ranges: tuple[ColorRange, ...]  # the boxes; a pixel matches if it is in one of them

    @property
    def is_colorless(self) -> bool:
        """Whether white, grey or black may match: a range of all hues, without any saturation."""
        return any(
            r.space == "lab" or (r.low[:2] == (0, 0) and r.high[0] == HUE_PERIOD - 1)
            for r in self.ranges
        )

    def mask(self, bgr: Bytes) -> Bytes:
        """255 where pixels of a BGR image (h, w, 3) match."""
        return self.mask_converted(ConvertedImage(bgr))

    def mask_converted(self, image: ConvertedImage) -> Bytes:
        """The same for an image that several colours look at: it is converted only once."""
        first, *others = (r.mask(image.to(r.space)) for r in self.ranges)
        for other in others:
            first = np.asarray(cv2.bitwise_or(first, other), dtype=np.uint8)
        return first

    def matches(self, bgr: ArrayLike) -> Bools:
        """Which of n BGR samples (n, 3) match."""
        samples = np.clip(np.rint(floats("bgr", bgr, "n", 3)), 0, 255).astype(np.uint8)
        return self.mask(samples[:, None, :])[:, 0] > 0

    @classmethod
    def named(cls, name: str) -> BallColor:
        """One of the common colours in `NAMED_RANGES`.

        Raises:
            KeyError: the name is not one of them.
        """
        return cls(name, NAMED_RANGES[name.lower()])

    @classmethod
    def from_samples(cls, bgr: ArrayLike, hue_margin: int = 6, level_margin: int = 30) -> BallColor:
        """Learn a range from BGR samples (n, 3), 0-255, taken under the light of the recording.

        The hue's range is the shortest arc that holds the central 90 % of the samples by
        saturation weight, widened by `hue_margin`; saturation and value run from the samples' 5 %
        quantile less `level_margin` up. Samples without colour (white, grey, black) are recognised
        by their brightness instead.

        Raises:
            ValueError: there are no samples.
        """
        samples = np.clip(floats("bgr", bgr, "n", 3), 0, 255).astype(np.uint8)[:, None, :]
        if not len(samples):
            raise ValueError("there are no colour samples")
        hsv = np.asarray(cv2.cvtColor(samples, cv2.COLOR_BGR2HSV), dtype=np.float64)[:, 0, :]
        learn = _colored_range if np.median(hsv[:, 1]) >= _LEAST_SATURATION else _colorless_range
        return cls("samples", (learn(hsv, hue_margin, level_margin),))


def _colored_range(hsv: Floats, hue_margin: int, level_margin: int) -> ColorRange:
    first, last = _hue_arc(hsv[:, 0], hsv[:, 1] * hsv[:, 2])
    first, last = np.floor(first - hue_margin), np.ceil(last + hue_margin)
    if last - first >= HUE_PERIOD - 1:
        hues = (0, HUE_PERIOD - 1)
    else:
        hues = (int(first) % HUE_PERIOD, int(last) % HUE_PERIOD)
    saturation, value = np.quantile(hsv[:, 1:], 0.05, axis=0) - level_margin
    low = (hues[0], max(int(saturation), 25), max(int(value), 20))
    return ColorRange("hsv", low, (hues[1], 255, 255))


def _colorless_range(hsv: Floats, _hue_margin: int, level_margin: int) -> ColorRange:
    saturation = int(np.quantile(hsv[:, 1], 0.95)) + level_margin
    darkest, brightest = np.quantile(hsv[:, 2], [0.05, 0.95])
    low = (0, 0, max(int(darkest) - level_margin, 0))
    high = (HUE_PERIOD - 1, min(saturation, 255), min(int(brightest) + level_margin, 255))
    return ColorRange("hsv", low, high)


def _hue_arc(hues: Floats, weights: Floats) -> tuple[float, float]:
    """Weighted 5 % and 95 % quantiles of hues (n,) about their circular mean, unwrapped."""
    angle = hues * (2 * np.pi / HUE_PERIOD)
    weights = weights + 1e-9
    mean = np.angle(np.sum(weights * np.exp(1j * angle)))
    offset = np.angle(np.exp(1j * (angle - mean)))
    order = np.argsort(offset)
    cumulated = np.cumsum(weights[order]) / np.sum(weights)
    low, high = np.interp([0.05, 0.95], cumulated, offset[order])
    centre = mean * HUE_PERIOD / (2 * np.pi)
    return centre + low * HUE_PERIOD / (2 * np.pi), centre + high * HUE_PERIOD / (2 * np.pi)


def _hsv(hue: tuple[int, int], saturation: int, value: int) -> ColorRange:
    return ColorRange("hsv", (hue[0], saturation, value), (hue[1], 255, 255))


NAMED_RANGES: dict[str, tuple[ColorRange, ...]] = {
    "red": (_hsv((168, 8), 90, 30),),
    "orange": (_hsv((2, 19), 110, 40),),
    "yellow": (_hsv((17, 38), 80, 40),),
    "green": (_hsv((38, 94), 60, 25),),
    "cyan": (_hsv((80, 100), 70, 40),),
    "blue": (_hsv((98, 130), 70, 30),),
    "purple": (_hsv((124, 163), 50, 30),),
    "magenta": (_hsv((145, 172), 60, 35),),
    "pink": (_hsv((147, 179), 40, 60),),
    "white": (ColorRange("hsv", (0, 0, 120), (179, 60, 255)),),
    "grey": (ColorRange("hsv", (0, 0, 30), (179, 80, 225)),),
    "black": (ColorRange("hsv", (0, 0, 0), (179, 255, 45)),),
}
"""Ranges wide enough for ordinary light and white balance a sixth off; neighbours overlap.
Samples from the recording are always better."""
