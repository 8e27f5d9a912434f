"""From frame sets to detections, states, positions and poses; no files, no printing."""

from measure.measuring.measurement import Measurement, Status
from measure.measuring.pipeline import Pipeline
from measure.measuring.profile import Profile
from measure.measuring.stages import Stages

__all__ = ["Measurement", "Pipeline", "Profile", "Stages", "Status"]
