"""The parts of a picture that are searched: windows and regions around colour segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.model import ConvertedImage
from measure_plugins.detectors._hough_steps import Find, hough_circles

_STRIDE = 4  # Stride of the pixels tested: segments are larger


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a picture."""

    origin: tuple[int, int]  # where it starts (x, y)
    image: ConvertedImage  # its pixels, with their conversions to colour spaces
    # the edges (h, w) found in it, by blur in px.
    edges: dict[float, Bytes] = field(default_factory=dict)


Region = tuple[slice, slice]
"""Rows and columns of a window."""


def cut(bgr: Bytes, low: Floats, high: Floats) -> Window | None:
    """The part of a picture between two corners (x, y); None if nothing of it is left."""
    size = np.array([bgr.shape[1], bgr.shape[0]])
    x0, y0 = np.clip(np.floor(low), 0, size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 1, 0, size).astype(int)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return None
    pixels = np.ascontiguousarray(bgr[y0:y1, x0:x1])
    return Window((int(x0), int(y0)), ConvertedImage(pixels))


def regions(segments: Bytes, smallest_px: float, margin_px: float) -> list[Region]:
    """Boxes that hold all segments of at least `smallest_px` extent, none overlapping another.

    Args:
        segments: (h, w), not zero inside segments.
        smallest_px: segments that extend less in both directions cannot be a ball.
        margin_px: margin around a segment for the centre of a partly occluded ball.
    """
    height, width = segments.shape
    _, _, stats, _ = cv2.connectedComponentsWithStats(
        np.ascontiguousarray(segments[::_STRIDE, ::_STRIDE])
    )
    box = np.asarray(stats, dtype=np.int64)[1:, :4] * _STRIDE
    box = box[np.max(box[:, 2:], axis=1) >= smallest_px]
    margin = int(np.ceil(margin_px)) + _STRIDE
    low = np.maximum(box[:, :2] - margin, 0)
    high = np.minimum(box[:, :2] + box[:, 2:] + margin, [width, height])
    return [
        (slice(int(y0), int(y1)), slice(int(x0), int(x1)))
        for x0, y0, x1, y1 in _merged(np.concatenate([low, high], axis=1))
    ]


def _merged(boxes: Ints) -> Ints:
    """Boxes (n, 4) x0 y0 x1 y1 with every two that overlap replaced by the box around both."""
    out: list[Ints] = []
    for box in boxes:
        grown = True
        while grown:
            grown = False
            for other in out:
                if np.all(box[:2] < other[2:]) and np.all(other[:2] < box[2:]):
                    out = [kept for kept in out if kept is not other]
                    box = np.concatenate(
                        [np.minimum(box[:2], other[:2]), np.maximum(box[2:], other[2:])]
                    )
                    grown = True
                    break
        out.append(box)
    return np.array(out, dtype=np.int64).reshape(-1, 4)


@dataclass(frozen=True)
class HoughSearch:
    """Parameters of the search in a window."""

    radius_px: tuple[float, float]
    min_distance_px: float
    circles: int
    first_threshold: int  # where the bisection starts, votes


def finder(
    border: Bytes, parts: Sequence[Region], search: HoughSearch, dp: float, param1: float
) -> Find:
    """The Hough detection on edges (h, w) of step 6, region by region.

    Regions with few edges come first, and once there are more circles than expected the rest is
    left out: that is all the bisection asks, and low thresholds are slow on many edges.
    """
    crops = [
        (np.count_nonzero(border[part]), np.array([part[1].start, part[0].start, 0.0]), part)
        for part in parts
    ]
    crops = sorted((crop for crop in crops if crop[0]), key=lambda crop: crop[0])
    pixels = [np.ascontiguousarray(border[part]) for _, _, part in crops]

    def find(threshold: int) -> Floats:
        found = np.zeros((0, 3))
        for (_, start, _), crop in zip(crops, pixels, strict=True):
            circles = hough_circles(
                crop, threshold, search.radius_px, search.min_distance_px, dp, param1
            )
            found = np.concatenate([found, circles + start])
            if len(found) > search.circles:
                break
        return found

    return find
