"""Pictures with colour at half the resolution of brightness, as most cameras store them (4:2:0).

A mosaic of colour filters leaves fringes of wrong colour at edges. Stored at half the resolution
they mostly cancel; where they are stored whole, in PNG or JPEG 4:2:2, edges follow them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO

import cv2
import numpy as np

from measure.model import Expectation, Image

_BEYOND_PX = 16  # What rays, and the light beside a ball, reach beyond its search
_MOSAIC = 1.5
"""Ratio of how rough green is at the two kinds of place of a mosaic: 1.00 to 1.22 in pictures
without one or stored as JPEG, 5.8 to 7.4 in those whose mosaic was interpolated bilinearly."""
_HALF_BOTH_WAYS = 2  # Pillow's number of 4:2:0
_LAPLACE = np.array([[0, -1, 0], [-1, 4, -1], [0, -1, 0]], np.float32)


def has_fringes(image: Image) -> bool:
    """Whether colour is stored whole behind a mosaic, by the file or by the picture itself.

    Where green was interpolated, every other pixel as on a chessboard, it is smoother than where it
    was measured (Gallagher and Chen 2008, section 3).
    """
    if image.encoded is not None:
        return has_full_color(image.encoded)
    green = np.asarray(image.pixels[..., 1], np.float32)
    rough = np.abs(cv2.filter2D(green, -1, _LAPLACE))
    one, other = (rough[::2, k::2].mean() + rough[1::2, 1 - k :: 2].mean() for k in (0, 1))
    return bool(max(one, other) > _MOSAIC * min(one, other))


def has_full_color(data: bytes) -> bool:
    """Whether a picture keeps colour finer than at half the resolution of brightness (4:2:0)."""
    from PIL.JpegImagePlugin import JpegImageFile, get_sampling

    try:
        return bool(get_sampling(JpegImageFile(BytesIO(data))) != _HALF_BOTH_WAYS)
    except (OSError, SyntaxError):  # no JPEG, says Pillow
        return True


def with_coarse_color(image: Image, expected: Sequence[Expectation]) -> Image:
    """The same picture with colour at half the resolution where balls are expected."""
    size_wh = np.array(image.pixels.shape[1::-1]) // 2 * 2
    centers = np.array([one.center_px for one in expected])
    reach = np.array([[2 * one.radius_px[1] + one.reach_px + _BEYOND_PX] for one in expected])
    boxes = np.stack([centers - reach, centers + reach])
    boxes = np.clip(boxes // 2 * 2, 0, size_wh).astype(np.int64)
    shown = (boxes[0] < boxes[1]).all(axis=1)
    if not shown.any():
        return image
    low, high = boxes[0, shown].min(axis=0), boxes[1, shown].max(axis=0)
    pixels = np.array(image.pixels)
    part = pixels[low[1] : high[1], low[0] : high[0]]
    colored = cv2.cvtColor(part, cv2.COLOR_BGR2YCrCb)
    size = (part.shape[1], part.shape[0])
    half = cv2.resize(colored, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA)
    colored[..., 1:] = cv2.resize(half, size, interpolation=cv2.INTER_LINEAR)[..., 1:]
    part[:] = cv2.cvtColor(colored, cv2.COLOR_YCrCb2BGR)
    return replace(image, decode=lambda: pixels)
