"""One Hough detection over the regions of a window, with the accumulator threshold left free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins.detectors._hough_bisection import Find
from measure_plugins.detectors._hough_regions import Region
from measure_plugins.detectors._hough_steps import hough_circles


@dataclass(frozen=True)
class HoughSearch:
    """Parameters of the search in a window.

    Attributes:
        radius_px: smallest and largest radius.
        min_distance_px: least distance between centres.
        circles: number of circles expected.
        first_threshold: where the bisection starts, votes.
    """

    radius_px: tuple[float, float]
    min_distance_px: float
    circles: int
    first_threshold: int


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
