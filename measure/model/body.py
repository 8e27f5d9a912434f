"""The body: the rigid thing that is measured, known by its balls and their colours.

A ball's colour is a range in HSV or Lab, learnt from samples or given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bools, Bytes, Floats, floats
from measure.errors import DegenerateGeometryError

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


USUAL_RADIUS_TOLERANCE_MM = 0.05
COMMON_RADIUS_VARIANCE = 0.5
"""Share of the radii's variance that balls of one make and paint have in common."""
MIN_BREADTH_RATIO = 0.02
"""Balls whose second extent is below this share of the first count as collinear."""


@dataclass(frozen=True, eq=False)
class Ball:
    """One ball."""

    name: str  # unique within the body
    color: BallColor  # how its pixels are recognised
    center_mm: Floats  # (3,) in the body frame
    radius_mm: float  # of the sphere

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "center_mm", floats(f"ball {self.name}: center_mm", self.center_mm, 3)
        )
        if not np.isfinite(self.center_mm).all():
            raise ValueError(f"ball {self.name}: center_mm must be finite, got {self.center_mm}")
        if not 0 < self.radius_mm < np.inf:
            raise ValueError(f"ball {self.name}: radius_mm must be positive, got {self.radius_mm}")


@dataclass(frozen=True, eq=False)
class Body:
    """At least three balls, each with a name of its own, not on one line.

    Attributes:
        name: of the body.
        balls: where they should be.
        tolerance_mm: standard deviation of each coordinate of where they are; 0 is exact.
        radius_tolerance_mm: standard deviation of each radius; 0 is exact.
        measured_radii: covariance (k, k) in mm^2 of radii that were measured; None if they are as
            `radius_tolerance_mm` says.

    Raises:
        DegenerateGeometryError: fewer than three balls, or collinear ones.
        ValueError: two balls have one name, or a tolerance is none.
    """

    name: str
    balls: tuple[Ball, ...]
    tolerance_mm: float = 0.0
    radius_tolerance_mm: float = USUAL_RADIUS_TOLERANCE_MM
    measured_radii: Floats | None = None

    def __post_init__(self) -> None:
        if len(self.balls) < 3:
            raise DegenerateGeometryError(
                f"body '{self.name}' has {len(self.balls)} balls: a pose needs at least 3"
            )
        if not 0 <= self.tolerance_mm < np.inf:
            raise ValueError(f"body '{self.name}': tolerance_mm must be 0 or more")
        if not 0 <= self.radius_tolerance_mm < np.inf:
            raise ValueError(f"body '{self.name}': radius_tolerance_mm must be 0 or more")
        if twice := {name for name in self.names if self.names.count(name) > 1}:
            names = " and ".join(f"'{name}'" for name in sorted(twice))
            raise ValueError(f"body '{self.name}': more than one ball is called {names}")
        spread = np.linalg.svd(self.centers - self.centers.mean(axis=0), compute_uv=False)
        if spread[1] < MIN_BREADTH_RATIO * spread[0]:
            raise DegenerateGeometryError(
                f"body '{self.name}': the balls lie on one line "
                f"(extents {spread[0]:.1f} and {spread[1]:.2f} mm), "
                "so a turn about it cannot be seen; move one ball off the line"
            )

    def with_centers(self, centers: Floats) -> Body:
        """The same balls at (k, 3) mm."""
        moved = zip(self.balls, centers, strict=True)
        return replace(self, balls=tuple(replace(ball, center_mm=at) for ball, at in moved))

    def with_radii(self, radii: Floats, covariance: Floats) -> Body:
        """The same balls with measured radii (k,) mm and their covariance (k, k) mm^2."""
        sized = zip(self.balls, radii.tolist(), strict=True)
        balls = tuple(replace(ball, radius_mm=radius) for ball, radius in sized)
        return replace(self, balls=balls, measured_radii=covariance)

    @cached_property
    def centers(self) -> Floats:
        """Ball centres (k, 3) in the body frame, mm."""
        return np.stack([ball.center_mm for ball in self.balls])

    @cached_property
    def middle(self) -> Floats:
        """Mean of the balls' centres (3,), mm; the origin may lie anywhere."""
        return np.mean(self.centers, axis=0)

    @cached_property
    def radii(self) -> Floats:
        """Ball radii (k,) in mm."""
        return np.array([ball.radius_mm for ball in self.balls])

    @cached_property
    def radius_covariance(self) -> Floats:
        """Covariance (k, k) in mm^2 of the radii: as measured, or by their tolerance."""
        if self.measured_radii is not None:
            return self.measured_radii
        alike, k = COMMON_RADIUS_VARIANCE, len(self.balls)
        return self.radius_tolerance_mm**2 * ((1 - alike) * np.eye(k) + alike)

    @cached_property
    def center_covariance(self) -> Floats:
        """Covariance (3, 3) in mm^2 of a ball's centre in the body frame, by the tolerance."""
        return self.tolerance_mm**2 * np.eye(3)

    @cached_property
    def distance_sd_mm(self) -> float:
        """Standard deviation of the distance between two balls, by the tolerance."""
        return math.sqrt(2) * self.tolerance_mm

    @cached_property
    def reach_mm(self) -> float:
        """Distance of the furthest ball's centre from the body's origin, mm."""
        return float(np.max(np.linalg.norm(self.centers, axis=1)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Ball names, in order."""
        return tuple(ball.name for ball in self.balls)

    def index(self, name: str) -> int:
        """Position of the ball called `name`."""
        return self._places[name]

    def centers_of(self, names: Sequence[str]) -> Floats:
        """Centres (n, 3) of the balls called `names` in the body frame, mm; not to be changed."""
        if tuple(names) == self.names:
            return self.centers
        return self.centers[[self.index(name) for name in names]]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def distances(self) -> dict[tuple[str, str], float]:
        """Centre-to-centre distance in mm of every pair of balls."""
        return {
            (a.name, b.name): float(np.linalg.norm(a.center_mm - b.center_mm))
            for i, a in enumerate(self.balls)
            for b in self.balls[i + 1 :]
        }


def paper_body() -> Body:
    """The body of the paper: three balls of radius 20 mm, 38 mm from the end effector."""
    places = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-38.0, 0.0, 0.0)}
    balls = tuple(Ball(n, BallColor.named(n), np.array(c), 20.0) for n, c in places.items())
    return Body("raven three-ball body", balls)
