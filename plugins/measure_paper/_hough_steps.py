"""The single steps of the paper's figure "Circle detection method", on one window."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.model import ConvertedImage


def gray_edges(bgr: Bytes, sigma_px: float, threshold: float) -> Bytes:
    """Steps 1 to 3: gray, Gaussian blur, Canny.

    Args:
        bgr: pixels (h, w, 3).
        threshold: Canny's upper threshold; the lower one is half of it.

    Returns:
        (h, w), 255 on edges.
    """
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    blurred = cv2.GaussianBlur(gray, (0, 0), sigma_px)
    return np.asarray(cv2.Canny(blurred, threshold / 2, threshold), dtype=np.uint8)


def enlarge(channel: Bytes, sigma_px: float, level: float) -> Bytes:
    """Step 5: blur a colour channel and binarise it, which enlarges its segments.

    Args:
        channel: (h, w), 255 where the colour matches (step 4).
        sigma_px: blur, 10 % of the radius.
        level: share of 255 from which a blurred pixel counts; below one half the segments grow.

    Returns:
        (h, w), 1 inside the enlarged segments, else 0.
    """
    height, width = channel.shape
    # A wide blur needs no fine grid: halve it while sigma stays above 1.5 px.
    shrink = 4 if sigma_px >= 6 else 2 if sigma_px >= 3 else 1
    small = cv2.resize(
        channel, (-(-width // shrink), -(-height // shrink)), interpolation=cv2.INTER_AREA
    )
    # As float32: OpenCV's exact 8-bit Gaussian is eight times slower.
    blurred = cv2.GaussianBlur(small.astype(np.float32), (0, 0), sigma_px / shrink)
    segments = np.asarray(blurred > 255.0 * level, dtype=np.uint8)
    if shrink == 1:
        return segments
    return np.asarray(
        cv2.resize(segments, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8
    )


def refine_border(edges: Bytes, segments: Bytes) -> Bytes:
    """Step 6: the element-wise product, edges (h, w) of step 3 inside segments (h, w) of step 5."""
    return np.asarray(edges * segments, dtype=np.uint8)


def hough_circles(
    edges: Bytes,
    threshold: int,
    radius_px: tuple[float, float],
    min_distance_px: float,
    dp: float,
    param1: float,
) -> Floats:
    """Step 7: OpenCV's gradient Hough transform.

    Args:
        edges: (h, w) of step 6.
        threshold: `param2`, votes a centre needs.
        dp: inverse resolution of the accumulator.
        param1: upper threshold of the Canny step inside OpenCV.

    Returns:
        (n, 3) x, y, radius in px, the best supported first.
    """
    found = cv2.HoughCircles(
        edges,
        cv2.HOUGH_GRADIENT,
        dp,
        max(min_distance_px, 1.0),
        param1=param1,
        param2=threshold,
        minRadius=max(int(np.floor(radius_px[0])), 1),
        maxRadius=max(int(np.ceil(radius_px[1])), 2),
    )
    if found is None:
        return np.zeros((0, 3))
    return np.asarray(found, dtype=np.float64).reshape(-1, 3)


def color_share(channel: Bytes, circle: Floats, samples: int, ring: tuple[float, float]) -> float:
    """Step 8: the share of sample points near and inside the border that have the colour.

    Args:
        channel: (h, w), 255 where the colour matches.
        circle: (3,) x, y, radius in px.
        samples: number of directions; each is sampled at both ends of the ring.
        ring: inner and outer end, as shares of the radius. Points outside the picture do not match.
    """
    angles = np.arange(samples) * (2 * np.pi / samples)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.concatenate([circle[:2] + circle[2] * reach * around for reach in ring])
    x, y = np.rint(points).astype(np.int64).T
    inside = (x >= 0) & (x < channel.shape[1]) & (y >= 0) & (y < channel.shape[0])
    return float(np.count_nonzero(channel[y[inside], x[inside]]) / len(points))


Find = Callable[[int], Floats]
"""Circles (n, 3) found with an accumulator threshold: x, y, radius in px."""

_DESCENT = 0.7
"""The search comes down from high thresholds in small steps: a low one costs ten times as much."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """The circles at the tuned threshold."""

    circles: Floats  # (n, 3) x, y, radius in px; n is at most the number expected
    threshold: int
    jumped: bool  # whether one vote less gives too many circles and this threshold too few
    sigma_px: float = float("nan")  # blur they were found with; NaN until `tune_blur` has set it


def tune_threshold(find: Find, expected: int, lowest: int, start: int) -> Tuned:
    """Bisect to the lowest threshold that still gives no more than `expected` circles.

    The paper, section II.C: "Suppose k circles are expected, the algorithm uses bisection to
    approach the lower bound of para2, such that HoughCircle comes close to returning (k+1) circles
    but still returns k. In the case where para2 jumps between (k-1) and (k+1), increasing sigma in
    Gaussian blur helps, but is conducted only if necessary."

    Args:
        find: the Hough detection, with the threshold free.
        lowest: lowest threshold that is tolerated, in votes.
        start: first threshold tried; high ones are cheap, so the search comes from above.
    """
    above, circles, below = _bracket(find, expected, lowest, max(start, lowest))
    while above - below > 1:
        middle = (above + below) // 2
        found = find(middle)
        if len(found) > expected:
            below = middle
        else:
            above, circles = middle, found
    reached_edge = above > lowest
    return Tuned(circles, above, jumped=reached_edge and len(circles) < expected)


def tune_blur(
    find_with: Callable[[float], Find],
    sigmas_px: Iterable[float],
    expected: int,
    lowest: int,
    start: int,
) -> Tuned:
    """Tune the threshold; raise the blur only while it jumps from too few to too many circles.

    Args:
        find_with: gives the Hough detection for a blur in px.
        sigmas_px: the blurs to try, ascending, at least one; after the last one it gives up and
            `jumped` stays true.
    """
    tuned: Tuned | None = None
    for sigma_px in sigmas_px:
        found = tune_threshold(find_with(sigma_px), expected, lowest, start)
        tuned = Tuned(found.circles, found.threshold, found.jumped, sigma_px)
        if not tuned.jumped:
            break
    assert tuned is not None
    return tuned


def _bracket(find: Find, expected: int, lowest: int, start: int) -> tuple[int, Floats, int]:
    """A threshold with at most `expected` circles, its circles, and one with more (or too low)."""
    threshold, circles = start, find(start)
    if len(circles) > expected:
        while len(circles) > expected:
            below, threshold = threshold, threshold + threshold // 2 + 1
            circles = find(threshold)
        return threshold, circles, below
    while threshold > lowest:
        lower = lowest if threshold <= 2 * lowest else int(_DESCENT * threshold)
        found = find(lower)
        if len(found) > expected:
            return threshold, circles, lower
        threshold, circles = lower, found
    return threshold, circles, threshold - 1


_STRIDE = 4  # Stride of the pixels tested: segments are larger


@dataclass(frozen=True, eq=False)
class CircleWindow:
    """A part of a picture."""

    origin: tuple[int, int]  # where it starts (x, y)
    image: ConvertedImage  # its pixels, with their conversions to colour spaces
    # the edges (h, w) found in it, by blur in px.
    edges: dict[float, Bytes] = field(default_factory=dict)


Region = tuple[slice, slice]
"""Rows and columns of a window."""


def cut(bgr: Bytes, low: Floats, high: Floats) -> CircleWindow | None:
    """The part of a picture between two corners (x, y); None if nothing of it is left."""
    size = np.array([bgr.shape[1], bgr.shape[0]])
    x0, y0 = np.clip(np.floor(low), 0, size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 1, 0, size).astype(int)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return None
    pixels = np.ascontiguousarray(bgr[y0:y1, x0:x1])
    return CircleWindow((int(x0), int(y0)), ConvertedImage(pixels))


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
