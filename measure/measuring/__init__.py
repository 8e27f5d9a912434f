"""From frame sets to detections, states, positions and poses; no files, no printing."""

from measure.measuring.measurement import Measurement, Status
from measure.measuring.pipeline import Pipeline, Profile, Stage, Stages
from measure.measuring.several_bodies import (
    measure_together,
    relative_measurement,
    relative_measurements,
)

__all__ = [
    "Measurement", "Pipeline", "Profile", "Stage", "Stages", "Status", "measure_together",
    "relative_measurement", "relative_measurements",
]  # fmt: skip
