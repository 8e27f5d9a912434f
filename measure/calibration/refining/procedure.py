"""From a measured session to a refined calibration: cameras, clocks, and the verdict on both.

Clocks are compared by `measure.checking.clocks`. An offset that is not significant is not applied:
it would move the cameras by noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining import judgement
from measure.calibration.refining.recording import Recording, calibration_disagrees, recording_of
from measure.calibration.refining.refine import Refinement, RefineSettings, refine_rig
from measure.checking.clocks import CameraClock, estimate_clocks
from measure.measuring import Measurement
from measure.model import Body, Camera, Detection

_MAX_STEP_S = 0.1  # Frame sets further apart do not determine velocities, nor clocks
_CLOCK_FRAME_SETS = 400


@dataclass(frozen=True, eq=False)
class RefinedRig:
    """A refined rig and the verdict on it."""

    recording: Recording
    refinement: Refinement
    # one a camera, in order; empty if the frame sets are too far apart.
    clocks: tuple[CameraClock, ...]
    clocks_applied: bool  # whether their offsets were beyond doubt, and were used
    verdict: judgement.RefineVerdict


def refine_measured(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> RefinedRig:
    """Refine cameras over a measured session.

    Args:
        joint_covariance: of all cameras together, if the first calibration states it.

    Raises:
        CalibrationError: too little seen, too little motion, or an implausible result.
    """
    recording = recording_of(measurements, body)
    clocks, trusted = _clocks(cameras, body, measurements, recording, settings, joint_covariance)
    applied = trusted and any(clock.offset_visible or clock.rolling for clock in clocks)
    if applied:
        recording = recording_of(measurements, body, _lead(clocks, cameras))
    halves = judgement.compare_halves(cameras, body, recording, settings, joint_covariance)
    refinement = refine_rig(
        cameras, body, recording, settings, joint_covariance, halves.variance_factor
    )
    judgement.refuse_misfit(refinement, body)
    verdict = judgement.judge_refinement(cameras, body, recording, refinement, halves)
    if applied:
        refinement = replace(refinement, cameras=_with_readout(refinement.cameras, clocks))
    return RefinedRig(recording, refinement, clocks, applied, verdict)


def rough_cameras(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> tuple[Camera, ...] | None:
    """Cameras good enough to measure with, where the first ones disagree too much for that.

    Returns:
        The cameras; None if the first ones will do.

    Raises:
        CalibrationError: too little seen, or too little motion.
    """
    if not calibration_disagrees(measurements):
        return None
    recording = recording_of(measurements, body, doubtful_too=True)
    return refine_rig(cameras, body, recording, settings, joint_covariance).cameras


def _clocks(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    recording: Recording,
    settings: RefineSettings | None,
    joint: Floats | None,
) -> tuple[tuple[CameraClock, ...], bool]:
    """The clocks, and whether to trust them: a moved camera resembles a late one.

    They are compared with cameras that were refined with free clocks, so that clock errors are not
    in the cameras.
    """
    if float(np.median(np.diff(recording.times_s))) > _MAX_STEP_S:
        return (), False
    part = recording.part(0, _CLOCK_FRAME_SETS)
    free = refine_rig(cameras, body, part, settings, joint, clocks_are_exact=False)
    judgement.refuse_misfit(free, body)
    trusted = judgement.worst_misfit(free, body)[1] < judgement.SUSPICIOUS_PX
    return estimate_clocks(measurements[:_CLOCK_FRAME_SETS], body, free.cameras), trusted


def _with_readout(cameras: tuple[Camera, ...], clocks: Sequence[CameraClock]) -> tuple[Camera, ...]:
    """The cameras with the readout times that were seen beyond doubt added to their own."""
    return tuple(
        replace(camera, readout_s=camera.readout_s + clock.readout_s) if clock.rolling else camera
        for camera, clock in zip(cameras, clocks, strict=True)
    )


def _lead(
    clocks: tuple[CameraClock, ...], cameras: tuple[Camera, ...]
) -> Callable[[Detection], float]:
    """What to add to a detection's time: its camera's offset, its row's if the shutter rolls."""
    by_name = {clock.camera: clock for clock in clocks}
    rolling = {
        camera.name: replace(camera, readout_s=clock.readout_s if clock.rolling else 0.0)
        for camera, clock in zip(cameras, clocks, strict=True)
    }

    def lead(detection: Detection) -> float:
        clock = by_name[detection.camera]
        delay = float(rolling[detection.camera].row_delay_s(detection.center_px[1]))
        return clock.offset_s + delay

    return lead
