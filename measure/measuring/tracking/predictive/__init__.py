"""Tracking by prediction: a motion filter, search windows and gates from covariances."""
