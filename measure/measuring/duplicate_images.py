"""Duplicate images: a camera delivers its last image again, or another camera's.

A stalled camera or driver repeats its last image with a new stamp: measured at that, it would put
the body where it was before. One device opened under two names, or a wrong input of a video
switch, shows another camera's images: they fit that camera's calibration only. Sensor noise makes
two exposures differ, so identical pixels mean the same exposure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from measure.model import FrameSet, Image

_ROW_STEP = 32  # Every so many rows are compared
_MIN_IMAGES = 2  # New images with which a frame set is measured without the duplicates
_LATEST = 3
"""Images of a camera that those of others are compared with: two readers of one device may be a
frame or two apart."""
_MIN_CONTRAST = 24
"""Levels between the darkest and brightest pixel from which equal images are one exposure: JPEG
rounds the noise of black ones (a lens cap, a dark room) away, so that two cameras' may be equal."""


@dataclass(frozen=True)
class Duplicates:
    """The duplicates of a frame set."""

    repeated: tuple[str, ...]  # cameras whose image is the same as in the frame set before
    shared: tuple[tuple[str, str], ...]  # pairs of cameras of which both show one exposure


@dataclass(frozen=True, eq=False)
class NewImages:
    """A frame set without duplicates, if two others are left; else the same, and a flag."""

    frame_set: FrameSet
    flag: str  # a doubt of its pose; empty without one
    shared: tuple[tuple[str, str], ...]  # see `Duplicates`


class DuplicateImages:
    """Compares every camera's image with its last one, and with those of the other cameras.

    Attributes:
        copies: cameras that show another one's images now, with that one's name.
    """

    def __init__(self) -> None:
        self._latest: dict[str, deque[tuple[int, Hashable]]] = {}
        self.copies: Mapping[str, str] = {}
        self._is_located = False

    def without_duplicates(self, frame_set: FrameSet) -> NewImages:
        """Leave out images that repeat those before, and those of `copies`.

        As long as it is not known which of two cameras shows the other's, both are left out until
        there is a pose to tell: a search would find a second body in the wrong one.
        """
        images, found = frame_set.images, self.of(frame_set)
        self.copies = {
            copy: whose
            for copy, whose in self.copies.items()
            if not images.keys() >= {copy, whose}
            or {copy, whose} & {*found.repeated}
            or {copy, whose} in map(set, found.shared)
        }
        out = {*found.repeated, *self.copies}
        if not self._is_located:
            out |= {n for pair in found.shared if not self.copies.keys() & {*pair} for n in pair}
        new = {name: image for name, image in images.items() if name not in out}
        if len(new) in (len(images), *range(_MIN_IMAGES)):
            names = ", ".join(found.repeated)
            flag = f"the pictures of {names} repeat those before: a stall?" if names else ""
            return NewImages(frame_set, flag, found.shared)
        return NewImages(replace(frame_set, images=new), "", found.shared)

    def judge(self, shared: Collection[tuple[str, str]], used: Collection[str]) -> str:
        """Find which of two cameras with the same images shows the other's; a flag if unknown.

        Args:
            shared: pairs of cameras, as in `Duplicates`.
            used: the cameras that the pose rests on: the images fit one calibration only.
        """
        self._is_located = bool(used)
        fits = [(b, a) if a in used else (a, b) for a, b in shared if (a in used) != (b in used)]
        self.copies = {**self.copies, **dict(fits)}
        open_ = [pair for pair in shared if not self.copies.keys() & {*pair}]
        return "; ".join(
            f"{a} and {b} show the same pictures: one device under two names?" for a, b in open_
        )

    def of(self, frame_set: FrameSet) -> Duplicates:
        """The duplicates among these images and those of the last calls."""
        images = frame_set.images
        prints = {name: _fingerprint(image) for name, image in images.items()}
        repeated = [n for n, image in images.items() if self._repeats(image, prints[n])]
        for name, image in images.items():
            self._latest.setdefault(name, deque(maxlen=_LATEST)).append((image.frame, prints[name]))
        latest = {name: {one for _, one in self._latest[name]} for name in images}
        shared = [
            (a, b)
            for a, b in combinations([n for n in images if n not in repeated], 2)
            if (prints[a] in latest[b] or prints[b] in latest[a]) and _has_contrast(images[a])
        ]
        return Duplicates(tuple(repeated), tuple(shared))

    def _repeats(self, image: Image, print_: Hashable) -> bool:
        if image.camera not in self._latest:
            return False
        frame, last = self._latest[image.camera][-1]
        return frame != image.frame and last == print_


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
