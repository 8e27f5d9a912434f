"""Tracking by prediction: a motion filter, search windows and gates from covariances."""

from measure.measuring.tracking.predictive.tracker import PredictiveConfig, PredictiveTracker

__all__ = ["PredictiveConfig", "PredictiveTracker"]
