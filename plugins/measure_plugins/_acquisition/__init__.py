"""Search of whole pictures for balls: colour segments, then circles; candidates only."""

from measure_plugins._acquisition.candidates import FoundCircles, find_circles, warm_up

__all__ = ["FoundCircles", "find_circles", "warm_up"]
