"""Search of whole pictures for balls: colour segments, then circles; candidates only."""

from measure_plugins._acquisition.candidates import FoundCircles, find_circles, warm_up
from measure_plugins._acquisition.small import MIN_RADIUS_PX

__all__ = ["MIN_RADIUS_PX", "FoundCircles", "find_circles", "warm_up"]
