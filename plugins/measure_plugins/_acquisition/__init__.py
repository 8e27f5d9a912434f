"""Search of whole pictures for balls: colour segments, then circles; candidates only."""

from measure_plugins._acquisition.candidates import (
    AcquisitionSettings,
    FoundCircles,
    find_circles,
    warm_up,
)

__all__ = ["AcquisitionSettings", "FoundCircles", "find_circles", "warm_up"]
