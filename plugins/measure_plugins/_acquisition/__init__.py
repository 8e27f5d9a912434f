"""Finding balls with no idea where they are: colour, then circles; geometry decides later."""

from measure_plugins._acquisition.candidates import AcquisitionSettings, find_circles, warm_up

__all__ = ["AcquisitionSettings", "find_circles", "warm_up"]
