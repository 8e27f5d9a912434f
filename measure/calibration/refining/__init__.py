"""Refinement of a calibration from the moving body."""
