"""Calibrations, trackers' poses and exports in the formats of other programs."""
