"""The one family of errors a user is meant to read.

A message says what is wrong, where (file, line, camera, frame) and what to do about it. The
command line prints it in one line and exits with 2; any other exception is a defect of ours and
keeps its traceback.
"""

from __future__ import annotations


class MeasureError(Exception):
    """Something the user can mend; its message explains how."""


class ConfigError(MeasureError):
    """A setting, profile or command-line value that cannot be used."""


class SessionError(MeasureError):
    """A recording (its files, images, videos, clocks or body) that cannot be used as it is."""


class CaptureError(MeasureError):
    """A camera that cannot be reached, breaks off, or delivers what cannot be used."""


class CalibrationError(MeasureError):
    """Cameras whose calibration is missing, does not fit, or cannot be computed."""


class PluginError(MeasureError):
    """A plugin that is unknown, broken, ambiguous or breaks its contract."""


class FitError(PluginError):
    """An estimator that fails while it learns: with other settings it may not."""


class RunError(MeasureError):
    """A run folder that cannot be written, read, resumed or evaluated."""


class DegenerateGeometryError(MeasureError):
    """Geometry that does not determine the answer (parallel rays, collinear balls)."""


class EstimatorError(MeasureError):
    """A data set, model or state stream an estimator cannot work with."""


class DivergedError(EstimatorError):
    """A fit whose numbers grew beyond all bounds: other settings may do."""
