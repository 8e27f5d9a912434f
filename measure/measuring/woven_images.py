"""Images woven of two instants (interlaced): every other row shows the ball elsewhere.

Those rows are displaced against the rows between them, in every image alike, by a share of the
step that the ball makes from image to image. Grain, a mosaic of colour filters and compression
displace neighbouring rows as well, but not along the motion.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.limits import FEWEST, SIGNIFICANT_SIGMAS
from measure.model import Detection, FrameSet

_FIELD_SHARE = 0.15
"""Of the time between two images, the least between their fields: half of it, and less where a
large displacement of blurred rows is underestimated; 0 +- 0.01 in one exposure."""
_REACH = 1.3  # How far out is looked, in radii
_LARGEST_STEP = 0.5  # Steps larger than this, in radii, blur the displacement of rows too much
_LATEST, _EVERY = 30, 17
"""Frame sets that are looked at first; and after so many, of how many one."""
_REMEMBERED = 90  # Outlines of a camera
_FLAG = re.compile(r"pictures of (.+?) are woven of two instants")


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
        return index < _LATEST or index % _EVERY == 0

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
    def flag(self) -> str:
        """A doubt of poses that rest on them; empty without one."""
        names = ", ".join(self.cameras)
        return f"pictures of {names} are woven of two instants: interlaced?" if names else ""


def woven_cameras(flags: Sequence[str]) -> list[str]:
    """The cameras that `WovenImages.flag` names in any of these texts."""
    found = (match[1].split(", ") for flag in flags for match in _FLAG.finditer(flag))
    return sorted({name for names in found for name in names})


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
    (x, y), r = ball.center_px.tolist(), _REACH * ball.radius_px
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
