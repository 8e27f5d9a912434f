"""Refinement of a calibration from the moving body."""

from measure.calibration.refining.procedure import (
    RefinedRig,
    RefineVerdict,
    judge_refinement,
    refine_measured,
    rough_cameras,
)
from measure.calibration.refining.recording import Recording, Track
from measure.calibration.refining.refine import Refinement, RefineSettings, refine_rig

__all__ = [
    "Recording", "RefineSettings", "RefineVerdict", "RefinedRig", "Refinement", "Track",
    "judge_refinement", "refine_measured", "refine_rig", "rough_cameras",
]  # fmt: skip
