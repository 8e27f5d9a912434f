"""Tracking: predicts the body from earlier frame sets and gates detections."""

from measure.host import Tracker, hookimpl
from measure.measuring.tracking.memoryless import Memoryless
from measure.measuring.tracking.predictive import PredictiveTracker


@hookimpl
def measure_trackers() -> list[type[Tracker]]:
    """Register the two trackers."""
    return [Memoryless, PredictiveTracker]
