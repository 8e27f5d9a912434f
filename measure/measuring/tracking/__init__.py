"""What tracking knows from earlier frames, and how it judges what the detectors say."""

from typing import Any

from measure.measuring.tracking.memoryless import Memoryless
from measure.measuring.tracking.paper.frame_update import FrameUpdate
from measure.measuring.tracking.predictive.tracker import PredictiveTracker
from measure.measuring.tracking.tracker import Tracker, Verdict

TRACKERS: dict[str, type[Any]] = {
    "frame-update": FrameUpdate,
    "memoryless": Memoryless,
    "predictive": PredictiveTracker,
}
"""By the name a profile gives; each is built as (config, body, cameras) and is a `Tracker`."""

__all__ = ["TRACKERS", "FrameUpdate", "Tracker", "Verdict"]
