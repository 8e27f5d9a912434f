"""Tracking by prediction: a motion filter, search windows and gates from covariances."""

from measure.measuring.tracking.predictive.settings import PredictiveConfig
from measure.measuring.tracking.predictive.tracker import PredictiveTracker

__all__ = ["PredictiveConfig", "PredictiveTracker"]
