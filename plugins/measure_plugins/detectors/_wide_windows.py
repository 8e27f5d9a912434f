"""Windows wider than their balls, in which balls are searched by colour first.

Rays across a predicted outline miss a ball that lies beside it. A body that was just found and
moves, or is seen a few times a second, may be anywhere in such a window.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.model import Camera, Detection, Expectation
from measure.model.lens import bearing

_CONVINCING_SHARE = 2 / 3  # Score above which a ball is not searched elsewhere
_CIRCLE_ERROR_PX = 4.0  # Error of a circle found by colour, in centre and radius
_REACH_SIGMAS = 3.5  # Reach of a window in standard deviations of the prediction


def lost_in_wide_windows(
    expected: Sequence[Expectation], found: Sequence[Detection]
) -> tuple[Expectation, ...]:
    """Balls not found, or with a low score, in a window that reaches further than their radius."""
    sure = {d.ball for d in found if d.score >= _CONVINCING_SHARE}
    return tuple(
        e
        for e in expected
        if e.ball not in sure and e.center_camera is not None and e.reach_px > sum(e.radius_px) / 2
    )


def moved_to_circles(
    lost: Sequence[Expectation], circles: Mapping[str, Floats], camera: Camera
) -> list[Expectation]:
    """Expectations of lost balls at circles of their colour in their windows.

    One circle is one ball: pairs are taken in the order of their likelihood, by the distance of a
    circle from the expected place and by how complete it is.

    Args:
        lost: balls expected somewhere in wide windows.
        circles: (k, 6) by name of the ball, see `FoundCircles`.
    """
    pairs = [
        (likelihood, i, (x, y))
        for i, e in enumerate(lost)
        for x, y, radius, seen, filled, *_ in circles[e.ball].tolist()
        if (likelihood := seen * filled * _nearness(e, x, y, radius)) > 0
    ]
    places: dict[int, tuple[float, float]] = {}
    for _, i, place in sorted(pairs, reverse=True):
        if i not in places and place not in places.values():
            places[i] = place
    return [_moved(lost[i], np.array(place), camera) for i, place in sorted(places.items())]


def _nearness(expected: Expectation, x: float, y: float, radius: float) -> float:
    """Relative likelihood of a ball at a circle, 1 at best; 0 outside its window."""
    low, high = expected.radius_px
    away_px = math.hypot(x - expected.center_px[0], y - expected.center_px[1])
    if (
        away_px > expected.reach_px
        or not low - _CIRCLE_ERROR_PX <= radius <= high + _CIRCLE_ERROR_PX
    ):
        return 0.0
    return math.exp(-((_REACH_SIGMAS * away_px / expected.reach_px) ** 2) / 2)


def better_of(
    found: Sequence[Detection], again: Sequence[Detection], lost: Sequence[Expectation]
) -> list[Detection]:
    """Detections `found`, with those of `lost` balls replaced by better ones of `again`."""
    best, names = {d.ball: d for d in found}, {e.ball for e in lost}
    for d in again:
        if d.ball in names and (d.ball not in best or d.score > best[d.ball].score):
            best[d.ball] = d
    return list(best.values())


def _moved(expected: Expectation, center_px: Floats, camera: Camera) -> Expectation:
    """The same ball, as far away, in another place of the picture."""
    assert expected.center_camera is not None
    distance = float(np.linalg.norm(expected.center_camera))
    axis = bearing(center_px, camera.intrinsics.row)
    return replace(
        expected, center_px=center_px, reach_px=_CIRCLE_ERROR_PX, center_camera=distance * axis
    )


def radii_about(radius_px: float) -> tuple[float, float]:
    """Smallest and largest radius in px of an outline found from a rough circle."""
    spread = 0.25 * radius_px + 3
    return radius_px - spread, radius_px + spread


def center_by_size(expectation: Expectation, camera: Camera, radius_mm: float) -> Floats:
    """Centre (3,) in mm in the camera frame of a ball of the expected size in the picture."""
    axis = bearing(expectation.center_px, camera.intrinsics.row)
    half_angle = sum(expectation.radius_px) / 2 / camera.intrinsics.focal_px
    return axis * (radius_mm / np.sin(half_angle))
