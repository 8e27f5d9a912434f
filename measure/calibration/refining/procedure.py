"""From a measured session to a refined calibration: cameras, clocks, and whether to believe them.

Clocks are compared as everywhere else in the program (`measure.checking.clocks`). An offset that
the motion does not show beyond doubt is not applied: it would only move the cameras to where the
noise wants them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.halves import compare_halves
from measure.calibration.refining.judgement import (
    SUSPICIOUS_PX,
    RefineVerdict,
    judge_refinement,
    refuse_misfit,
    worst_misfit,
)
from measure.calibration.refining.recording import (
    Recording,
    calibration_doubted,
    recording_of,
)
from measure.calibration.refining.refine import Refinement, RefineSettings, refine_rig
from measure.checking.clocks import CameraClock, estimate_clocks
from measure.measuring import Measurement
from measure.model import Body, Camera, Detection

_LONGEST_STEP_S = 0.1
"""Frame sets further apart say nothing about velocities, nor therefore about clocks."""
_FOR_CLOCKS = 400


@dataclass(frozen=True, eq=False)
class RefinedRig:
    """A refined rig, and what is to be said about it.

    Attributes:
        recording: what it rests on.
        refinement: cameras, ball centres, residuals.
        clocks: one a camera, in order; empty if the frame sets are too far apart to tell.
        clocks_applied: whether their offsets were beyond doubt, and were used.
        verdict: whether to believe it.
    """

    recording: Recording
    refinement: Refinement
    clocks: tuple[CameraClock, ...]
    clocks_applied: bool
    verdict: RefineVerdict


def refine_measured(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> RefinedRig:
    """Refine cameras over a measured session.

    Args:
        cameras: as calibrated.
        body: nominal body.
        measurements: of all frame sets, in order.
        settings: what may change.
        joint_covariance: of all cameras together, if the first calibration states it.

    Raises:
        CalibrationError: too little seen, too little motion, or a result that is not to be
            believed.
    """
    recording = recording_of(measurements, body)
    clocks, believed = _clocks(cameras, body, measurements, recording, settings, joint_covariance)
    applied = believed and any(clock.offset_visible or clock.rolling for clock in clocks)
    if applied:
        recording = recording_of(measurements, body, _lead(clocks, cameras))
    halves = compare_halves(cameras, body, recording, settings, joint_covariance)
    refinement = refine_rig(cameras, body, recording, settings, joint_covariance, halves.caution)
    refuse_misfit(refinement, body)
    verdict = judge_refinement(cameras, body, recording, refinement, halves)
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
    if not calibration_doubted(measurements):
        return None
    recording = recording_of(measurements, body, doubted=True)
    return refine_rig(cameras, body, recording, settings, joint_covariance).cameras


def _clocks(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    recording: Recording,
    settings: RefineSettings | None,
    joint: Floats | None,
) -> tuple[tuple[CameraClock, ...], bool]:
    """The clocks, and whether they may be believed: a camera that was moved looks like a late one.

    They are compared with cameras that were refined while the clocks were free, and so owe nothing
    to clocks that are off.
    """
    if float(np.median(np.diff(recording.times_s))) > _LONGEST_STEP_S:
        return (), False
    part = recording.part(0, _FOR_CLOCKS)
    free = refine_rig(cameras, body, part, settings, joint, clocks_are_exact=False)
    refuse_misfit(free, body)
    believed = worst_misfit(free, body)[1] < SUSPICIOUS_PX
    return estimate_clocks(measurements[:_FOR_CLOCKS], body, free.cameras), believed


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
        camera.name: replace(camera, readout_s=by_name[camera.name].readout_s)
        if by_name[camera.name].rolling
        else replace(camera, readout_s=0.0)
        for camera in cameras
    }

    def lead(detection: Detection) -> float:
        clock = by_name[detection.camera]
        delay = float(rolling[detection.camera].row_delay_s(detection.center_px[1]))
        return clock.offset_s + delay

    return lead
