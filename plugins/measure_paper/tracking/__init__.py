"""The frame update of the paper, section II.D."""

from measure.host import Tracker, hookimpl
from measure_paper.tracking.frame_update import FrameUpdate, FrameUpdateSettings

__all__ = ["FrameUpdate", "FrameUpdateSettings"]


@hookimpl
def measure_trackers() -> list[type[Tracker]]:
    """Register the tracker."""
    return [FrameUpdate]
