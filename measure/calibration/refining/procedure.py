"""From a measured session to a refined calibration, and whether it deserves to replace the first.

Residuals do not show whether it does: constant errors of a recording are in its held-out frame sets
too. Checked are the size of the change against the first calibration's covariance, the residuals of
held-out frame sets before and after, and how much the covariance of the cameras shrinks.

The two halves of a recording are refined each by itself and tried on the other. Errors that drift
slowly with the body's pose (light, occlusion) are neither white noise nor a constant shift. They
make the two refinements differ by more than their covariances: the variance of every view is
widened by the ratio.

Clock offsets that are not significant are not applied: they would move the cameras by noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.recording import (
    MIN_MOTION_MM,
    Recording,
    calibration_disagrees,
    recording_of,
)
from measure.calibration.refining.refine import Refinement, RefineSettings, misfits_px, refine_rig
from measure.checking.clocks import CameraClock, estimate_clocks
from measure.errors import CalibrationError
from measure.estimation.expected_accuracy import body_pose_sd
from measure.geometry import chi_square_quantile
from measure.limits import CLEAR_RATIO, FEWEST, SINGULAR, SPREAD_OVER
from measure.measuring import Measurement
from measure.model import Body, Camera, Detection

UNTRIED_VARIANCE_FACTOR = 4.0
"""Variance factor without halves to compare: they often differ by two standard deviations."""
_MIN_EIGENVALUE_RATIO = 1e-3


@dataclass(frozen=True)
class Halves:
    """Result of the comparison."""

    # variance of the views' errors over that estimated from residuals.
    variance_factor: float = UNTRIED_VARIANCE_FACTOR
    # median residual of each half's views, with the first cameras and with those refined on the
    # other half; NaN if they could not be compared.
    held_out_px: tuple[float, float] = (float("nan"), float("nan"))


def compare_halves(
    first: tuple[Camera, ...],
    body: Body,
    recording: Recording,
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> Halves:
    """Refine each half by itself; the arguments are those of `refine_rig`."""
    count = len(recording.times_s)
    if count // 2 < FEWEST:
        return Halves()
    parts = (recording.part(0, count // 2), recording.part(count // 2, count))
    try:
        one, other = (refine_rig(first, body, p, settings, joint_covariance) for p in parts)
    except CalibrationError:
        return Halves()
    before = np.concatenate([misfits_px(first, body, part) for part in parts])
    after = np.concatenate(
        [misfits_px(r.cameras, body, p) for r, p in zip((other, one), parts, strict=True)]
    )
    held_out = (float(np.median(before)), float(np.median(after)))
    return Halves(max(1.0, _disagreement((one, other))), held_out)


def _disagreement(both: tuple[Refinement, Refinement]) -> float:
    """Mean squared difference of two refinements over its predicted variance.

    Both share the first calibration's error, so only what the recordings add counts: a refinement
    with the covariance P from a prior L^-1 has the variance P (P^-1 - L) P = P - P L P from its own
    recording.
    """
    owned = [r.covariance - r.covariance @ np.linalg.solve(r.prior, r.covariance) for r in both]
    spread: Floats = owned[0] + owned[1]
    determined = np.diag(spread) > SINGULAR * np.diag(both[0].prior)  # of a camera held nothing is
    spread, apart = (
        spread[np.ix_(determined, determined)],
        (both[0].change - both[1].change)[determined],
    )
    scale = 1 / np.sqrt(np.diag(spread))
    shares, axes = np.linalg.eigh((spread + spread.T) / 2 * scale[:, None] * scale)
    apart = axes.T @ (apart * scale)
    determined = shares > _MIN_EIGENVALUE_RATIO * shares[-1]
    return float(np.mean(apart[determined] ** 2 / shares[determined]))


_MAX_HELD_OUT_RATIO = 1.2
_LITTLE_GAIN_RATIO = 0.9
_MIN_DETERMINED_SHARE = 0.02
"""Directions whose prior variance the recording lowers by a smaller share are not tested."""
SUSPICIOUS_PX = 0.4
_MAX_MISFIT_PX = 1.5  # Light shifts the edges of glossy balls by about a pixel at most
_SURPRISE_CONFIDENCE = 0.999


@dataclass(frozen=True)
class RefineVerdict:
    """How good a refinement is."""

    # of the cameras' places (3-D RMS), before and after, from the covariances.
    camera_sd_mm: tuple[float, float]
    # of the body's position from the calibration alone (3-D RMS over the recorded poses), before
    # and after, from the covariances.
    body_sd_mm: tuple[float, float]
    # median residual of frame sets that played no part, before and after; NaN where there are too
    # few.
    held_out_px: tuple[float, float]
    # the size of the cameras' change against what the first calibration allows: about one where it
    # is right; NaN where the recording determines nothing.
    surprise: float
    notes: tuple[str, ...]


def judge_refinement(
    first: tuple[Camera, ...],
    body: Body,
    recording: Recording,
    refinement: Refinement,
    halves: Halves,
) -> RefineVerdict:
    """Judge a refinement; CalibrationError if the recording contradicts the first calibration."""
    surprise, limit = _surprise(refinement)
    if surprise > CLEAR_RATIO * limit:
        raise CalibrationError(_contradiction(refinement, surprise))
    held_out, held_out_after = halves.held_out_px
    if held_out_after > _MAX_HELD_OUT_RATIO * held_out:
        raise CalibrationError(
            f"frame sets that played no part in the refinement fit worse after it "
            f"({held_out_after:.2f} px) than before ({held_out:.2f} px): keep the first "
            "calibration, or record a longer motion through the whole workspace"
        )
    camera_sd = (
        _camera_sd(refinement, refinement.prior),
        _camera_sd(refinement, refinement.covariance),
    )
    body_sd = _body_sd(first, body, recording, refinement)
    notes = [_contradiction(refinement, surprise)] if surprise > limit else []
    notes += _notes(body, refinement, halves, camera_sd, body_sd)
    return RefineVerdict(camera_sd, body_sd, halves.held_out_px, surprise, tuple(notes))


def _notes(
    body: Body,
    refinement: Refinement,
    halves: Halves,
    camera_sd: tuple[float, float],
    body_sd: tuple[float, float],
) -> list[str]:
    notes = []
    if max(camera_sd[1] / camera_sd[0], body_sd[1] / body_sd[0]) > _LITTLE_GAIN_RATIO:
        notes.append(
            f"this recording adds little to the first calibration: camera positions known to "
            f"{camera_sd[0]:.3f} mm before and {camera_sd[1]:.3f} mm after, body positions to "
            f"{body_sd[0]:.3f} and {body_sd[1]:.3f} mm"
        )
    what, far = worst_misfit(refinement, body)
    if far > SUSPICIOUS_PX:
        notes.append(
            f"{what}: half hidden, lit from one side, or the camera was moved a little since it "
            "was calibrated"
        )
    if not np.isfinite(halves.held_out_px[0]):
        notes.append(f"{refinement.frames} frame sets are too few to hold some out and try them")
    return notes


def _body_sd(
    first: tuple[Camera, ...], body: Body, recording: Recording, refinement: Refinement
) -> tuple[float, float]:
    picked = np.unique(np.linspace(0, len(recording.times_s) - 1, SPREAD_OVER).astype(int))
    poses = [recording.world_from_body[int(i)] for i in picked]
    before, after = (
        body_pose_sd(cameras, body, poses, covariance)[0]
        for cameras, covariance in (
            (first, refinement.prior),
            (refinement.cameras, refinement.covariance),
        )
    )
    return float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2)))


def _camera_sd(refinement: Refinement, covariance: Floats) -> float:
    places = [np.diag(covariance)[columns[:3]].sum() for columns in refinement.columns.values()]
    return float(np.sqrt(np.mean(places)))


def _surprise(refinement: Refinement) -> tuple[float, float]:
    """Root mean squared change in its own standard deviations, and what it seldom exceeds.

    If the prior is right, the change is normal with the covariance prior - posterior.
    """
    P = refinement.prior
    scale = 1 / np.sqrt(np.diag(P))
    lower = np.linalg.cholesky(P * scale[:, None] * scale + 1e-12 * np.eye(len(P)))
    back = np.linalg.solve(lower, np.diag(scale))
    determined, axes = np.linalg.eigh(np.eye(len(P)) - back @ refinement.covariance @ back.T)
    moved = axes.T @ back @ refinement.change
    use = determined > _MIN_DETERMINED_SHARE
    if not np.any(use):
        return float("nan"), float("inf")
    count = int(np.count_nonzero(use))
    limit = np.sqrt(chi_square_quantile(_SURPRISE_CONFIDENCE, count) / count)
    return float(np.sqrt(np.mean(moved[use] ** 2 / determined[use]))), float(limit)


def _contradiction(refinement: Refinement, surprise: float) -> str:
    """Which camera's change is the least to be expected, in words."""
    worst, most = "", -1.0
    for name, columns in refinement.columns.items():
        change = refinement.change[columns]
        size = float(change @ np.linalg.solve(refinement.prior[np.ix_(columns, columns)], change))
        if size > most:
            worst, most = name, size
    change = refinement.change[refinement.columns[worst]]
    return (
        f"the recording contradicts the first calibration {surprise:.1f} times beyond its stated "
        f"errors, most of all camera {worst} (by {np.linalg.norm(change[:3]):.2f} mm and "
        f"{np.degrees(np.linalg.norm(change[3:6])):.2f} deg): if it was moved since, calibrate "
        "again"
    )


def worst_misfit(refinement: Refinement, body: Body) -> tuple[str, float]:
    """What neither the cameras' stated errors nor the motion explain: in words, and in px."""
    far = np.linalg.norm(refinement.shifts_px, axis=2)
    camera, ball = np.unravel_index(int(np.argmax(far)), far.shape)
    shift, name = float(far[camera, ball]), list(refinement.columns)[int(camera)]
    missing, miss = max(refinement.misfit_px.items(), key=lambda item: item[1])
    if miss > shift:
        return f"camera {missing} misses by {miss:.2f} px", miss
    return f"ball {body.balls[ball].name} sits {shift:.2f} px off in {name} all the time", shift


def refuse_misfit(refinement: Refinement, body: Body) -> None:
    """Refuse (CalibrationError) a recording in which a ball sits too far off or a camera misses."""
    what, far = worst_misfit(refinement, body)
    if far > _MAX_MISFIT_PX:
        raise CalibrationError(
            f"the calibration does not fit the recording: {what}; if a camera was moved since, "
            "calibrate again; else check the body file"
        )


_MAX_STEP_S = 0.1  # Frame sets further apart do not determine velocities, nor clocks
_CLOCK_FRAME_SETS = 400


@dataclass(frozen=True, eq=False)
class AdjustedRig:
    """A rig adjusted to a recording."""

    recording: Recording
    refinement: Refinement
    # one per camera, in order; empty if the frame sets are too far apart.
    clocks: tuple[CameraClock, ...]
    clocks_applied: bool  # whether their offsets were beyond doubt, and were used
    halves: Halves


@dataclass(frozen=True, eq=False)
class RefinedRig(AdjustedRig):
    """A refined rig and the verdict on it."""

    verdict: RefineVerdict


def refine_measured(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> RefinedRig:
    """Refine cameras over a measured session; CalibrationError: too little seen, or implausible."""
    rig = adjust_measured(cameras, body, measurements, settings, joint_covariance)
    verdict = judge_refinement(cameras, body, rig.recording, rig.refinement, rig.halves)
    return RefinedRig(**vars(rig), verdict=verdict)


def adjust_measured(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
    least_motion_mm: float = MIN_MOTION_MM,
) -> AdjustedRig:
    """Adjust cameras and clocks to a measured session, whatever the first cameras are worth."""
    recording = recording_of(measurements, body, least_motion_mm=least_motion_mm)
    clocks, trusted = _clocks(cameras, body, measurements, recording, settings, joint_covariance)
    applied = trusted and any(clock.offset_visible or clock.rolling for clock in clocks)
    if applied:
        lead = _lead(clocks, cameras)
        recording = recording_of(measurements, body, lead, least_motion_mm=least_motion_mm)
    halves = compare_halves(cameras, body, recording, settings, joint_covariance)
    refinement = refine_rig(
        cameras, body, recording, settings, joint_covariance, halves.variance_factor
    )
    refuse_misfit(refinement, body)
    if applied:
        refined = tuple(
            replace(c, readout_s=c.readout_s + clock.readout_s) if clock.rolling else c
            for c, clock in zip(refinement.cameras, clocks, strict=True)
        )
        refinement = replace(refinement, cameras=refined)
    return AdjustedRig(recording, refinement, clocks, applied, halves)


def rough_cameras(
    cameras: tuple[Camera, ...],
    body: Body,
    measurements: Sequence[Measurement],
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> tuple[Camera, ...] | None:
    """Cameras good enough to measure with, where the first disagree too much for that, or None."""
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
    refuse_misfit(free, body)
    trusted = worst_misfit(free, body)[1] < SUSPICIOUS_PX
    return estimate_clocks(measurements[:_CLOCK_FRAME_SETS], body, free.cameras), trusted


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
