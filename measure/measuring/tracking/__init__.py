"""What tracking knows from earlier frames, and how it judges what the detectors say."""

from measure.measuring.tracking.tracker import Tracker, Verdict

__all__ = ["Tracker", "Verdict"]
