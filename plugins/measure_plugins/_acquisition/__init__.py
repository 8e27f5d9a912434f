"""Search of whole pictures for balls: colour segments, then circles; candidates only."""

from measure_plugins._acquisition.candidates import (
    MIN_RADIUS_PX,
    FoundCircles,
    find_circles,
    warm_up,
)

__all__ = ["MIN_RADIUS_PX", "FoundCircles", "find_circles", "warm_up"]
