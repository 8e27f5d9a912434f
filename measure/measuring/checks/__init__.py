"""What is wrong or weak in a recording, told from the recording itself; no files, no printing."""

from measure.measuring.checks.colorless import ColorlessCount
from measure.measuring.checks.coverage import (
    Coverage,
    coverage_findings,
    expected_accuracy,
    expected_sd,
)
from measure.measuring.checks.damaged import damage_findings
from measure.measuring.checks.finding import Finding, Level
from measure.measuring.checks.moved import Misfit, camera_misfits, misfit_findings
from measure.measuring.checks.overexposed import OverexposedCount
from measure.measuring.checks.repeated import RepeatCount, repeat_findings
from measure.measuring.checks.stamps import stamp_findings
from measure.measuring.checks.survey import Surveyed, survey_frame_set, with_velocities

__all__ = [
    "ColorlessCount",
    "Coverage",
    "Finding",
    "Level",
    "Misfit",
    "OverexposedCount",
    "RepeatCount",
    "Surveyed",
    "camera_misfits",
    "coverage_findings",
    "damage_findings",
    "expected_accuracy",
    "expected_sd",
    "misfit_findings",
    "repeat_findings",
    "stamp_findings",
    "survey_frame_set",
    "with_velocities",
]
