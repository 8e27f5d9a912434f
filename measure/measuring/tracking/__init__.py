"""Tracking: predicts the body from earlier frame sets and gates detections."""

from typing import Any

from measure.measuring.tracking.paper import FrameUpdate
from measure.measuring.tracking.predictive import PredictiveTracker
from measure.measuring.tracking.tracker import Conclusion, Memoryless, Tracker

TRACKERS: dict[str, type[Any]] = {
    "frame-update": FrameUpdate,
    "memoryless": Memoryless,
    "predictive": PredictiveTracker,
}
"""By the name a profile gives; each is built as (config, body, cameras) and is a `Tracker`."""

__all__ = ["TRACKERS", "Conclusion", "FrameUpdate", "Tracker"]
