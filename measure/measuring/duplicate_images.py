"""Duplicate images: a camera delivers its last image again, or another camera's.

A stalled camera or driver repeats its last image with a new stamp: measured at that, it would put
the body where it was before. One device opened under two names, or a wrong input of a video
switch, shows another camera's images: they fit that camera's calibration only. Sensor noise makes
two exposures differ, so identical pixels mean the same exposure. Images that were encoded again
differ a little: the means of JPEG's blocks hardly do.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.model import FrameSet, Image

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
_LEFT_OUT = re.compile(r"(.+) shows the pictures of (.+)|(.+) repeats its last picture")


@dataclass(frozen=True)
class Duplicates:
    """The duplicates of a frame set."""

    repeated: tuple[str, ...]  # cameras whose image is the same as in the frame set before
    shared: tuple[tuple[str, str], ...]  # pairs of cameras that show one exposure


@dataclass(frozen=True, eq=False)
class NewImages:
    """A frame set without duplicates, if two others are left; else the same, and a flag."""

    frame_set: FrameSet
    flag: str  # a doubt of its pose; empty without one
    repeated: tuple[str, ...]  # see `Duplicates`
    shared: tuple[tuple[str, str], ...]


def left_out(reasons: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Cameras whose images are left out, by a measurement's doubts: whose they are, "" if old."""
    for match in filter(None, map(_LEFT_OUT.fullmatch, reasons)):
        yield match[1] or match[3], match[2] or ""


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
            names = ", ".join(found.repeated)
            flag = f"the pictures of {names} repeat those before: a stall?" if names else ""
            return NewImages(frame_set, flag, found.repeated, found.shared)
        return NewImages(replace(frame_set, images=new), "", found.repeated, found.shared)

    def judge(self, shared: Collection[tuple[str, str]], used: Collection[str]) -> str:
        """Find which of two cameras with the same images shows the other's; a flag if unknown.

        Args:
            shared: pairs of cameras, as in `Duplicates`.
            used: the cameras that the pose rests on: the images fit one calibration only.
        """
        self._used = frozenset(used)
        fits = [(b, a) if a in used else (a, b) for a, b in shared if (a in used) != (b in used)]
        self.copies = {**self.copies, **dict(fits)}
        open_ = [pair for pair in shared if not self.copies.keys() & {*pair}]
        return "; ".join(
            f"{a} and {b} show the same pictures: one device under two names?" for a, b in open_
        )

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
