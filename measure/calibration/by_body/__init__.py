"""Calibration by the waved body itself, without a board and without a first calibration."""
