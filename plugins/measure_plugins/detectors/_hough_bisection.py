"""Tuning of the accumulator threshold (`param2`), the paper's section II.C.

"Suppose k circles are expected, the algorithm uses bisection to approach the lower bound of para2,
such that HoughCircle comes close to returning (k+1) circles but still returns k. In the case where
para2 jumps between (k-1) and (k+1), increasing sigma in Gaussian blur helps, but is conducted only
if necessary."
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from measure.arrays import Floats

Find = Callable[[int], Floats]
"""Circles (n, 3) found with an accumulator threshold: x, y, radius in px."""

_DESCENT = 0.7
"""The search comes down from high thresholds in small steps: a low one costs ten times as much."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """The circles at the tuned threshold.

    Attributes:
        circles: (n, 3) x, y, radius in px; n is at most the number expected.
        jumped: whether one vote less gives too many circles and this threshold too few.
        sigma_px: blur they were found with; NaN until `tune_blur` has set it.
    """

    circles: Floats
    threshold: int
    jumped: bool
    sigma_px: float = float("nan")


def tune_threshold(find: Find, expected: int, lowest: int, start: int) -> Tuned:
    """Bisect to the lowest threshold that still gives no more than `expected` circles.

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
        expected: see `tune_threshold`.
        lowest: see `tune_threshold`.
        start: see `tune_threshold`.
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
