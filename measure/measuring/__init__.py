"""From frame sets to detections, states, positions and poses; no files, no printing."""

from measure.measuring.measurement import Measurement, Status
from measure.measuring.pipeline import Pipeline, Stages
from measure.measuring.profile import Profile, Stage
from measure.measuring.relative import relative_measurement, relative_measurements
from measure.measuring.together import measure_together

__all__ = [
    "Measurement", "Pipeline", "Profile", "Stage", "Stages", "Status", "measure_together",
    "relative_measurement", "relative_measurements",
]  # fmt: skip
