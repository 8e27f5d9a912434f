"""Images that spoil a measurement: duplicates, images woven of two instants, and blurred ones.

A stalled camera or driver repeats its last image with a new stamp: measured at that, it would put
the body where it was before. One device opened under two names, or a wrong input of a video
switch, shows another camera's images: they fit that camera's calibration only. Sensor noise makes
two exposures differ, so identical pixels mean the same exposure. Images that were encoded again
differ a little: the means of JPEG's blocks hardly do.

In an interlaced image every other row shows the ball elsewhere. Those rows are displaced against
the rows between them, in every image alike, by a share of the step that the ball makes from image
to image. Grain, a mosaic of colour filters and compression displace neighbouring rows as well, but
not along the motion.

A stand that shakes blurs images along one direction: edges of balls are wide there. A ball that
moves while the shutter is open is blurred along its own path, by a share of its step from image to
image. What stays the same whichever way balls move is none of theirs: it moves outlines by more
than the scatter of their edges says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.arrays import Bytes, Floats
from measure.estimation.losses import HUBER_SIGMAS, Huber
from measure.limits import FEWEST, SIGNIFICANT_SIGMAS, TINY
from measure.model import Detection, Doubt, FrameSet, Image

_ROW_STEP = 32  # Every so many rows are compared
_MIN_IMAGES = 2  # New images with which a frame set is measured without the duplicates
_LATEST = 3
"""Images of a camera that those of others are compared with: two readers of one device may be a
frame or two apart."""
_MIN_CONTRAST = 24
"""Levels between the darkest and brightest pixel from which equal images are one exposure: JPEG
rounds the noise of black ones (a lens cap, a dark room) away, so that two cameras' may be equal."""
_BLOCK_PX, _SURROUNDINGS = 8, 9
"""Size of a block; and blocks across a square whose mean is taken from each, so that what is left
are things, and not light."""
_ALIKE = 0.98  # Correlation of blocks: encoded again 0.999; of two cameras at most 0.5
_SAME_LEVELS, _OTHER_LEVELS = 2.0, 10.0
"""Change of a block's mean up to which an image may be encoded again (at JPEG quality 40), and from
which a body moves: a fifth of a pixel, and a pixel, at the edge of a ball."""


@dataclass(frozen=True)
class Duplicates:
    """The duplicates of a frame set."""

    repeated: tuple[str, ...]  # cameras whose image is the same as in the frame set before
    shared: tuple[tuple[str, str], ...]  # pairs of cameras that show one exposure


@dataclass(frozen=True, eq=False)
class NewImages:
    """A frame set without duplicates, if two others are left; else the same, and a flag."""

    frame_set: FrameSet
    flags: tuple[Doubt, ...]  # of its pose
    repeated: tuple[str, ...]  # see `Duplicates`
    shared: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class _Glance:
    """What is remembered of an image."""

    frame: int
    exact: Hashable  # equal for images of the same pixels only
    # means of blocks (h, w); and those less their surroundings, of unit length, empty if there is
    # hardly anything to be seen.
    blocks: NDArray[np.float32]
    things: NDArray[np.float32]

    @classmethod
    def of(cls, image: Image) -> _Glance:
        """A look at all its pixels; nothing of an image without."""
        pixels, nothing = np.asarray(image.pixels), np.empty((0, 0), np.float32)
        if pixels.ndim != 3 or min(pixels.shape[:2]) < _BLOCK_PX:
            return cls(image.frame, _fingerprint(image), nothing, nothing)
        rows, columns = (size // _BLOCK_PX for size in pixels.shape[:2])
        whole = pixels[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
        grey = cv2.cvtColor(whole, cv2.COLOR_BGR2GRAY).reshape(rows, _BLOCK_PX, -1)
        strips = grey.sum(axis=1, dtype=np.uint16).reshape(rows, columns, _BLOCK_PX)
        blocks = strips.sum(axis=2, dtype=np.uint16) / np.float32(_BLOCK_PX**2)
        things = blocks - cv2.blur(blocks, (_SURROUNDINGS, _SURROUNDINGS))
        size = float(np.linalg.norm(things))
        seen = np.ptp(things) >= _MIN_CONTRAST / 2
        return cls(image.frame, _fingerprint(image), blocks, things / size if seen else nothing)

    def looks_like(self, other: _Glance) -> bool:
        """Whether both show the same things at the same places."""
        if not self.things.size or self.things.shape != other.things.shape:
            return False
        return float(np.vdot(self.things, other.things)) > _ALIKE

    def change(self, before: _Glance) -> float:
        """Largest change of a block's mean, in levels; NaN if that is unknown."""
        if not self.blocks.size or self.blocks.shape != before.blocks.shape:
            return np.nan
        return float(np.max(np.abs(self.blocks - before.blocks)))


class DuplicateImages:
    """Compares every camera's image with its last one, and with those of the other cameras.

    Attributes:
        copies: cameras that show another one's images now, with that one's name.
    """

    def __init__(self) -> None:
        self._latest: dict[str, deque[_Glance]] = {}
        self.copies: Mapping[str, str] = {}
        self._used: frozenset[str] = frozenset()  # cameras that the last pose rests on
        self._moved: dict[str, bool] = {}  # whether a camera's last new image showed a motion
        self._stalled: set[str] = set()

    def without_duplicates(
        self, frame_set: FrameSet, each: Callable[..., Iterable[_Glance]] = map
    ) -> NewImages:
        """Leave out images that repeat those before, and those of `copies`.

        As long as it is not known which of two cameras shows the other's, both are left out until
        there is a pose to tell: a search would find a second body in the wrong one. Images are
        looked at by `each`, which may be the `map` of a pool.
        """
        images, found = frame_set.images, self.of(frame_set, each)
        self.copies = {
            copy: whose
            for copy, whose in self.copies.items()
            if not images.keys() >= {copy, whose}
            or {copy, whose} & {*found.repeated}
            or {copy, whose} in map(set, found.shared)
        }
        out = {*found.repeated, *self.copies}
        if not self._used:
            out |= {n for pair in found.shared if not self.copies.keys() & {*pair} for n in pair}
        new = {name: image for name, image in images.items() if name not in out}
        if len(new) in (len(images), *range(_MIN_IMAGES)):
            flags = (Doubt("stall", cameras=found.repeated),) if found.repeated else ()
            return NewImages(frame_set, flags, found.repeated, found.shared)
        return NewImages(replace(frame_set, images=new), (), found.repeated, found.shared)

    def judge(self, shared: Collection[tuple[str, str]], used: Collection[str]) -> list[Doubt]:
        """Find which of two cameras with the same images shows the other's; flags if unknown.

        Args:
            shared: pairs of cameras, as in `Duplicates`.
            used: the cameras that the pose rests on: the images fit one calibration only.
        """
        self._used = frozenset(used)
        fits = [(b, a) if a in used else (a, b) for a, b in shared if (a in used) != (b in used)]
        self.copies = {**self.copies, **dict(fits)}
        open_ = [pair for pair in shared if not self.copies.keys() & {*pair}]
        return [Doubt("same-pictures", cameras=pair) for pair in open_]

    def of(self, frame_set: FrameSet, each: Callable[..., Iterable[_Glance]] = map) -> Duplicates:
        """The duplicates among these images and those of the last calls."""
        images = frame_set.images
        glances = dict(zip(images, each(_Glance.of, images.values()), strict=True))
        repeated = self._repeating(glances)
        for name, glance in glances.items():
            self._latest.setdefault(name, deque(maxlen=_LATEST)).append(glance)
        shared = [
            (a, b)
            for a, b in combinations([n for n in images if n not in repeated], 2)
            if self._shows(glances[a], b, images[a]) or self._shows(glances[b], a, images[b])
        ]
        return Duplicates(tuple(repeated), tuple(shared))

    def _repeating(self, glances: Mapping[str, _Glance]) -> list[str]:
        """Cameras whose image is the last one, maybe encoded again.

        That is known of a camera in whose pictures the body moved, and all at once does not, while
        it does in the others.
        """
        new = {n for n in glances if n in self._latest}
        new = {n for n in new if glances[n].frame != self._latest[n][-1].frame}
        changes = {name: glances[name].change(self._latest[name][-1]) for name in new}
        moving = {name for name, change in changes.items() if change > _OTHER_LEVELS}
        still = {name for name, change in changes.items() if change < _SAME_LEVELS}
        exact = {name for name in new if glances[name].exact == self._latest[name][-1].exact}
        # Encoded again: as long as it looks the same. A stall of equal pixels ends with the first
        # others, which differ by their noise alone where the body rests.
        again = still & self._stalled
        others = (self._used & new) - still
        if others and others <= moving:
            again |= {name for name in still & self._used if self._moved.get(name)} - exact
        self._stalled = (self._stalled - new) | again
        again |= exact
        self._moved |= {name: name in moving for name in new - again}
        return [name for name in glances if name in again]

    def _shows(self, glance: _Glance, other: str, image: Image) -> bool:
        """Whether an image is one of the latest of another camera."""
        latest = self._latest[other]
        if any(glance.looks_like(before) for before in latest):
            return True
        return any(glance.exact == before.exact for before in latest) and _has_contrast(image)


def _fingerprint(image: Image) -> Hashable:
    """Equal for images of the same pixels only."""
    if image.encoded is not None:
        return hash(image.encoded)
    pixels = np.asarray(image.pixels)
    if pixels.ndim != 3:
        return object()  # without pixels, equal to no other
    return pixels.shape, hash(pixels[_ROW_STEP // 2 :: _ROW_STEP].tobytes())


def _has_contrast(image: Image) -> bool:
    return bool(np.ptp(np.asarray(image.pixels)[::_ROW_STEP]) >= _MIN_CONTRAST)


_FIELD_SHARE = 0.15
"""Of the time between two images, the least between their fields: half of it, and less where a
large displacement of blurred rows is underestimated; 0 +- 0.01 in one exposure."""
_WOVEN_REACH = 1.3  # How far out is looked, in radii
_LARGEST_STEP = 0.5  # Steps larger than this, in radii, blur the displacement of rows too much
_LATEST_WOVEN, _EVERY = 30, 17
"""Frame sets that are looked at first; and after so many, of how many one."""
_REMEMBERED = 90  # Outlines of a camera


class BallStep(NamedTuple):
    """A ball seen in two images of a camera in a row."""

    ball: Detection  # in the second one
    pixels: Bytes  # of that one
    step_px: Floats  # (2,)


class BallSteps:
    """Remembers where balls were in the last images."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], tuple[int, Floats]] = {}

    def due(self, index: int) -> bool:
        """Whether a frame set of this number is worth a look: what a camera does, it does on."""
        return index < _LATEST_WOVEN or index % _EVERY == 0

    def of(self, frame_set: FrameSet, balls: Iterable[Detection], look: bool) -> list[BallStep]:
        """Take the balls found in a frame set; of a `look`, those seen one image before, too."""
        steps = []
        for ball in balls:
            image, key = frame_set.images[ball.camera], (ball.camera, ball.ball)
            frame, center_px = self._last.get(key, (image.frame, ball.center_px))
            self._last[key] = image.frame, ball.center_px
            if look and image.frame == frame + 1 and np.ndim(image.pixels) == 3:
                steps.append(BallStep(ball, image.pixels, ball.center_px - center_px))
        return steps


class WovenImages:
    """Judges the latest images of each camera by the balls found in them.

    Attributes:
        cameras: those whose rows are displaced along the motion, as far as is beyond chance.
    """

    def __init__(self) -> None:
        self._steps: dict[str, deque[tuple[Floats, Floats]]] = {}
        self.cameras: list[str] = []

    def add(self, steps: Sequence[BallStep]) -> None:
        """Look at the rows of balls that were seen in two images in a row."""
        for ball, pixels, step_px in steps:
            if np.linalg.norm(step_px) > _LARGEST_STEP * ball.radius_px:
                continue
            between_px = _between_fields(pixels, ball)
            if between_px is not None:
                latest = self._steps.setdefault(ball.camera, deque(maxlen=_REMEMBERED))
                latest.append((step_px, between_px))
        if steps:
            found = (name for name, latest in self._steps.items() if _are_woven(latest))
            self.cameras = sorted(found)

    @property
    def flags(self) -> list[Doubt]:
        """Doubts of poses that rest on them."""
        return [Doubt("interlaced", cameras=self.cameras)] if self.cameras else []


def _are_woven(latest: Sequence[tuple[Floats, Floats]]) -> bool:
    if len(latest) < FEWEST:
        return False
    steps, between = np.array(latest).transpose(1, 0, 2).reshape(2, -1)
    energy = float(steps @ steps)
    if energy == 0:
        return False
    share = float(steps @ between) / energy
    left = between - share * steps
    sd = np.sqrt(float(left @ left) / (len(left) - 1) / energy)
    return abs(share) > max(_FIELD_SHARE, SIGNIFICANT_SIGMAS * sd)


def _between_fields(pixels: Bytes, ball: Detection) -> Floats | None:
    """How far (2,) px even rows show a ball from where odd rows do; None if hardly any is seen.

    By the gradient of smoothed pictures (Lucas and Kanade, 1981).
    """
    (x, y), r = ball.center_px.tolist(), _WOVEN_REACH * ball.radius_px
    top, left = max(round(y - r), 0), max(round(x - r), 0)
    picture = np.asarray(pixels)
    if picture.ndim != 3:  # there are detections alone, of a simulation
        return None
    part = picture[top : round(y + r) + 1, left : round(x + r) + 1]
    if min(part.shape[:2]) < FEWEST:
        return None
    # Brightness alone: rows share their colour in JPEG and video.
    grey = cv2.cvtColor(part, cv2.COLOR_BGR2GRAY).astype(np.float32)
    around, rows = (grey[:-2] + grey[2:]) / 2, grey[1:-1]
    sign = np.where(np.arange(top + 1, top + 1 + len(rows)) % 2, -1, 1).astype(np.float32)
    width = max(round(ball.radius_px / 2), 3)
    differences = cv2.blur(sign[:, None] * (rows - around), (width, width)).ravel()
    down, right = np.gradient(cv2.blur((rows + around) / 2, (width, width)))
    slopes = np.stack([right.ravel(), down.ravel()]).astype(np.float64)
    normal = slopes @ slopes.T
    if np.linalg.matrix_rank(normal) < 2:
        return None
    return np.asarray(np.linalg.solve(normal, slopes @ differences), np.float64)


_LEAST_PX = 7.0
"""A shorter blur is not reported: shading and compression widen edges unevenly by up to 6 px."""
_SECTORS, _RAYS, _FEWEST = 16, 4, 10
"""Parts of an outline, of so many rays each, and how many must stand out."""
_RISE_PX = 4  # Over which a slope is measured: noise makes the steepest of shorter ones too steep
_SMEAR_REACH, _REACH_PX = 0.3, 12.0
"""How far to both sides an edge is sampled at most, in radii and in px: shading is wider."""
_LEAST_STEP = 15.0  # Levels between both sides of an edge whose width is known
_ROUNDS = 5  # Of weighting again: a shadow or another ball lies beside some edges
SHARP_CAMERAS = 2  # From which on a pose rests on cameras without blur as well


class SmearedImages:
    """Judges the latest images of each camera by the edges of balls found in them.

    Attributes:
        smear: the cameras whose images are blurred, beyond chance and whichever way balls move,
            the width of their edges, and the direction from the rows towards the columns.
    """

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], deque[tuple[Floats, Floats]]] = {}
        self.smear: Doubt | None = None

    def add(self, steps: Sequence[BallStep]) -> None:
        """Look at the edges of balls that were seen in two images in a row."""
        for ball, pixels, step_px in steps:
            edges = _edges(pixels, ball)
            if edges is not None:
                own = self._edges.setdefault((ball.camera, ball.ball), deque(maxlen=_REMEMBERED))
                own.append((edges, step_px))
        if steps:
            self.smear = self._judged()

    def _judged(self) -> Doubt | None:
        known = {k: s for k, edges in self._edges.items() if (s := _smear(edges)) is not None}
        cameras = {camera for camera, _ in known}
        if len(known) == len(cameras):  # One ball alone may be shaded so in all its pictures
            return None
        width_px, angle_deg = max(known.values())
        names = sorted(cameras)
        return Doubt("blurred", cameras=names, width_px=width_px, angle_deg=round(angle_deg))

    def doubt(self, used: Collection[str]) -> tuple[list[Doubt], bool]:
        """The note on a pose that rests on some cameras, and whether that flags it."""
        if self.smear is None or not (smeared := {*used} & {*self.smear.names("cameras")}):
            return [], False
        return [self.smear], len({*used} - smeared) < SHARP_CAMERAS


def _smear(latest: Sequence[tuple[Floats, Floats]]) -> tuple[float, float] | None:
    """Width in px and direction in deg of a blur that no motion of the balls makes.

    Squares of widths are w^2 + (l cos)^2 + (e v cos)^2, with a blur of l px along one direction and
    an exposure of e steps v; the cosines of twice the angles leave two numbers of each outline.
    """
    if len(latest) < FEWEST:
        return None
    edges, steps = (np.array(column) for column in zip(*latest, strict=True))
    x, y = steps.T
    one, none = np.ones(len(x)), np.zeros(len(x))
    design = np.concatenate(
        [np.stack([one, none, (x**2 - y**2) / 2], axis=1), np.stack([none, one, x * y], axis=1)]
    )
    values, covariance = _robust(design, edges[:, 1:].T.ravel())
    uneven = float(np.hypot(*values[:2]))  # l^2 / 2
    along = values[:2] / max(uneven, TINY)
    sd = float(np.sqrt(along @ covariance[:2, :2] @ along))
    if np.sqrt(2 * uneven) < _LEAST_PX or uneven < SIGNIFICANT_SIGMAS * sd:
        return None
    width_px = float(np.sqrt(max(np.median(edges[:, 0]) + uneven, 0)))
    return width_px, float(np.degrees(np.arctan2(values[1], values[0])) / 2)


def _edges(pixels: Bytes, ball: Detection) -> Floats | None:
    """Squares of widths (px^2) of a ball's edge: mean, and the parts as cos and sin of twice (3,).

    A width is the step of brightness over the edge through its steepest slope. None if too little
    of the edge is in the image, or stands out.
    """
    (x, y), r = ball.center_px.tolist(), ball.radius_px
    angles = 2 * np.pi * np.arange(_SECTORS * _RAYS) / (_SECTORS * _RAYS)
    reach = min(_SMEAR_REACH * r, _REACH_PX)
    radii = np.arange(r - reach, r + reach)
    u = x + np.cos(angles)[:, None] * radii
    v = y + np.sin(angles)[:, None] * radii
    height, width = np.asarray(pixels).shape[:2]
    left, top = int(u.min()), int(v.min())
    if len(radii) < FEWEST or left < 0 or top < 0 or u.max() > width - 1 or v.max() > height - 1:
        return None
    part = np.asarray(pixels)[top : int(v.max()) + 2, left : int(u.max()) + 2]
    grey = cv2.cvtColor(part, cv2.COLOR_BGR2GRAY).astype(np.float32)
    at_u, at_v = (u - left).astype(np.float32), (v - top).astype(np.float32)
    rays = cv2.remap(grey, at_u, at_v, cv2.INTER_LINEAR).astype(np.float64)
    light = rays.reshape(_SECTORS, _RAYS, -1).mean(axis=1)
    slopes = np.abs(light[:, _RISE_PX:] - light[:, :-_RISE_PX]).max(axis=1) / _RISE_PX
    sides = max(len(radii) // 4, 2)
    step = np.abs(light[:, :sides].mean(axis=1) - light[:, -sides:].mean(axis=1))
    clear = step > _LEAST_STEP
    if np.count_nonzero(clear) < _FEWEST:
        return None
    twice = 2 * angles.reshape(_SECTORS, _RAYS).mean(axis=1)
    parts = np.stack([np.ones(_SECTORS), np.cos(twice), np.sin(twice)], axis=1)
    return _robust(parts[clear], (step[clear] / slopes[clear]) ** 2)[0]


def _robust(design: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Parameters and covariance of a linear model (n, k) of values (n,), by Huber's weights."""
    weights, ridge = np.ones(len(values)), 1e-9 * np.eye(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (weights[:, None] * design) + ridge
        found = np.linalg.solve(normal, design.T @ (weights * values))
        left = np.abs(values - design @ found)
        sd = max(1.48 * float(np.median(left)), TINY)  # of a Gaussian, by its median
        weights = Huber(HUBER_SIGMAS * sd).weights(left)
    return np.asarray(found, np.float64), np.asarray(sd**2 * np.linalg.inv(normal), np.float64)
