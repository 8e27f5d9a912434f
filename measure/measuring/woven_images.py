"""Images woven of two instants (interlaced): the edges of balls that move look like combs.

Each field of such an image shows the ball elsewhere, and an outline between the two.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from measure.arrays import Bytes
from measure.model import Detection, FrameSet, Image

_COMB_LEVELS = 12  # By which a row differs from both its neighbours, the same way: noise is less
_COMB_SHARE = 0.3
"""Of an outline's length in px, pixels that do so where it moves by a pixel between the fields."""
_COMBED_SHARE, _LEAST_COMBED = 0.2, 3  # Of images: where the body rests, no image shows a comb
_COMB_REACH = 1.2  # How far out is looked, in radii
_LATEST, _EVERY = 30, 17
"""Images of a camera that are remembered; and after so many, of how many one is looked at."""
_FLAG = re.compile(r"pictures of (.+?) are woven of two instants")


class WovenImages:
    """Judges the latest images of each camera by the balls found in them."""

    def __init__(self) -> None:
        self._combed: dict[str, deque[bool]] = {}

    def due(self, index: int) -> bool:
        """Whether a frame set of this number is worth a look: a camera weaves all its images."""
        return index < _LATEST or index % _EVERY == 0

    def add(self, frame_set: FrameSet, balls: Iterable[Detection]) -> None:
        """Look at the outlines of some balls found in a frame set."""
        by_camera: dict[str, bool] = {}
        for ball in balls:
            if not by_camera.get(ball.camera, False):
                by_camera[ball.camera] = _is_combed(frame_set.images[ball.camera], ball)
        for name, combed in by_camera.items():
            self._combed.setdefault(name, deque(maxlen=_LATEST)).append(combed)

    @property
    def cameras(self) -> list[str]:
        """Those of which many images are combed."""
        return [
            name
            for name, looks in self._combed.items()
            if sum(looks) >= max(_LEAST_COMBED, _COMBED_SHARE * len(looks))
        ]

    @property
    def flag(self) -> str:
        """A doubt of poses that rest on them; empty without one."""
        names = ", ".join(sorted(self.cameras))
        return f"pictures of {names} are woven of two instants: interlaced?" if names else ""


def woven_cameras(flags: Sequence[str]) -> list[str]:
    """The cameras that `WovenImages.flag` names in any of these texts."""
    found = (match[1].split(", ") for flag in flags for match in _FLAG.finditer(flag))
    return sorted({name for names in found for name in names})


def _is_combed(image: Image, ball: Detection) -> bool:
    pixels = np.asarray(image.pixels)
    if pixels.ndim != 3:
        return False
    (x, y), r = ball.center_px.tolist(), _COMB_REACH * ball.radius_px
    part = pixels[max(round(y - r), 0) : round(y + r) + 1, max(round(x - r), 0) : round(x + r) + 1]
    if min(part.shape[:2]) < 3:
        return False
    # Noise, and what JPEG makes of it, does so along rows as well.
    combed = _alternating(part) - _alternating(part.transpose(1, 0, 2))
    return combed > _COMB_SHARE * 2 * math.pi * ball.radius_px


def _alternating(pixels: Bytes) -> int:
    """How many pixels differ from the rows above and below by as much, the same way."""
    rows = pixels.astype(np.int16)
    up, down = rows[1:-1] - rows[:-2], rows[1:-1] - rows[2:]
    same = (np.minimum(up, down) > _COMB_LEVELS) | (np.maximum(up, down) < -_COMB_LEVELS)
    blue, green, red = np.moveaxis(same, 2, 0)  # ten times as fast as `any` of an axis of three
    return int(np.count_nonzero(blue | green | red))
