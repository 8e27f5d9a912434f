"""The paper's frame-update algorithm: effective and suspended circles."""

from measure.measuring.tracking.paper.frame_update import FrameUpdate, FrameUpdateSettings

__all__ = ["FrameUpdate", "FrameUpdateSettings"]
