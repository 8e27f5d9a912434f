"""What is wrong or weak in a recording, told from the recording itself; no files, no printing."""

from measure.checking.coverage import (
    Coverage,
    coverage_findings,
    expected_accuracy,
)
from measure.checking.duplicates import (
    RepeatCount,
    damage_findings,
    repeat_findings,
    stamp_findings,
)
from measure.checking.finding import Finding, Level
from measure.checking.moved_cameras import Misfit, camera_misfits, misfit_findings
from measure.checking.overexposure import ColorlessCount, OverexposedCount
from measure.checking.sampled_search import Surveyed, survey_frame_set, with_velocities

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
    "misfit_findings",
    "repeat_findings",
    "stamp_findings",
    "survey_frame_set",
    "with_velocities",
]
