"""Cameras whose pose differs from the calibration: which, by how much, and since when.

The pose from all other cameras predicts where a camera should see the balls. A constant difference
means a wrong calibration, a step means that the camera was moved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.checking.finding import Finding, Level
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.association import associate
from measure.measuring.tracking.predictive.pose_checks import disagreeing_cameras
from measure.model import Body, Camera, Detection

_RADIUS_RATIO = 1.25
_REACH_PX = 80.0  # Largest distance of a candidate from where the ball should be
_MAX_STEP_S = 0.12  # Longest time between two samples that give a velocity


@dataclass(frozen=True, eq=False)
class SearchSample:
    """The association of one frame set."""

    time_s: float  # mean time of the images
    world_from_body: RigidTransform | None  # the pose with the highest score, or None
    agreeing: tuple[Detection, ...]  # the detections it rests on
    # per camera and ball, the candidate of about the right size nearest to where the ball should
    # be, however far off.
    nearest: tuple[Detection, ...]
    reason: str
    flags: tuple[str, ...] = ()
    # those that see balls, but none where the body should appear.
    disagreeing_cameras: tuple[str, ...] = ()
    # (6,) in the pose's `perturb` chart, per second; zero if unknown.
    velocity: Floats = field(default_factory=lambda: np.zeros(6))


def with_velocities(samples: Sequence[SearchSample]) -> list[SearchSample]:
    """Add velocities, from the nearest sample in time that has a pose, if it is near enough."""
    out = []
    for k, sample in enumerate(samples):
        near = [
            other
            for other in samples[max(k - 1, 0) : k + 2]
            if other is not sample
            and other.world_from_body is not None
            and 0 < abs(other.time_s - sample.time_s) < _MAX_STEP_S
        ]
        if sample.world_from_body is None or not near:
            out.append(sample)
            continue
        other = min(near, key=lambda o: abs(o.time_s - sample.time_s))
        assert other.world_from_body is not None
        step = other.world_from_body.difference(sample.world_from_body)
        out.append(replace(sample, velocity=step / (other.time_s - sample.time_s)))
    return out


def search_sample(
    detections: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
    time_s: float,
) -> SearchSample:
    """Find the body among candidates by camera name, and each camera's candidates nearest to it."""
    found = associate(body, cameras, detections)
    if found.world_from_body is None:
        return SearchSample(time_s, None, (), (), found.reason)
    centers = found.world_from_body.apply(body.centers)
    nearest: list[Detection] = []
    for camera in cameras:
        pixels = camera.project(centers)
        distances = np.linalg.norm(centers - camera.center, axis=1)
        for k, ball in enumerate(body.balls):
            radius = camera.intrinsics.focal_px * ball.radius_mm / distances[k]
            near = [
                (float(np.linalg.norm(d.center_px - pixels[k])), d)
                for d in detections.get(camera.name, ())
                if d.ball == ball.name and 1 / _RADIUS_RATIO < d.radius_px / radius < _RADIUS_RATIO
            ]
            best = min(near, key=lambda item: item[0], default=None)
            if best is not None and best[0] < _REACH_PX:
                nearest.append(best[1])
    return SearchSample(
        time_s,
        found.world_from_body,
        found.detections,
        tuple(nearest),
        "",
        found.flags,
        disagreeing_cameras(found, body, cameras, detections),
    )


_SYSTEMATIC_PX = 0.5
_MIN_STEP_PX, _MIN_BIAS_PX = 2.5, 3.5
"""A step may be smaller than a constant difference, which systematic errors of edges resemble."""
_MIN_INSTANTS = 3
_MIN_SHARE = 0.25
_SIGMAS = 5.0
_MAX_SPREAD_PX, _MAX_SPREAD_RATIO = 0.7, 0.3
_MAX_SIGMAS = 6.0  # Limit of one ball-view's deviation in the mean over the other cameras


@dataclass(frozen=True)
class CameraMisfit:
    """The difference of one camera from what the others predict."""

    camera: str
    shift_px: float  # mean length of the difference
    turn_deg: float  # the least rotation of the camera that explains it
    since_s: float | None  # when it began; None if it was there from the start
    instants: int  # how many frame sets it was seen in


class _Difference(NamedTuple):
    """One camera's difference from what the others predict in one frame set."""

    time_s: float  # the instant
    shift_px: Floats  # (2,) median over its balls
    turn: Floats  # (3,) least rotation vector of the camera that explains it, rad
    # standard deviation of the others' prediction: large for cameras that face each other, which
    # determine the depth badly.
    prediction_sd_px: float
    # mean deviation of the others from their common pose, in standard deviations.
    others_deviation: float


def camera_misfits(
    samples: Sequence[SearchSample], body: Body, cameras: Sequence[Camera]
) -> tuple[CameraMisfit, ...]:
    """Find cameras that do not fit, one after the other, each without those before it.

    A wrong camera distorts the pose to which the others are compared, so they seem to be off as
    well. The wrong one is that without which the others agree best, not that which differs most.
    Three cameras are needed: of two that disagree either may be wrong.
    """
    found: list[CameraMisfit] = []
    while len(cameras) - len(found) >= 3:
        out = {misfit.camera for misfit in found}
        rest = [camera for camera in cameras if camera.name not in out]
        compared = [_misfit(camera, samples, body, rest) for camera in rest]
        misfits = [pair for pair in compared if pair is not None]
        if not misfits:
            break
        found.append(min(misfits, key=lambda pair: pair[1])[0])
    return tuple(found)


def misfit_findings(
    misfits: Collection[CameraMisfit], tried_s: Mapping[str, float]
) -> list[Finding]:
    """One line for each, and whether its clock was tried as well, off by so much."""
    out = []
    for m in misfits:
        amount = f"{m.shift_px:.1f} px ({m.turn_deg:.2f} deg)"
        if m.since_s is None:
            text = f"{m.camera} sees the balls {amount} from where the others do: calibrate it"
        else:
            text = (
                f"{m.camera} was moved by {amount} at about {m.since_s:.2f} s: "
                "measure up to there, or calibrate it again for the rest"
            )
        if m.camera in tried_s:
            text += f" (a clock {1e3 * tried_s[m.camera]:+.0f} ms off explains less)"
        out.append(Finding(Level.WRONG, "calibration", text))
    return out


def _misfit(
    camera: Camera, samples: Sequence[SearchSample], body: Body, cameras: Sequence[Camera]
) -> tuple[CameraMisfit, float] | None:
    """A camera's misfit and the deviation of the others without it; None if it fits."""
    rows = [_difference(camera, sample, body, cameras) for sample in samples]
    kept = [row for row in rows if row is not None]
    if len(kept) < max(_MIN_INSTANTS, _MIN_SHARE * len(samples)):
        return None
    shifts, turns = np.stack([row.shift_px for row in kept]), np.stack([row.turn for row in kept])
    prediction_sd_px = float(np.median([row.prediction_sd_px for row in kept]))
    split = _step(shifts, prediction_sd_px)
    since = None
    if split is not None:
        since = kept[split].time_s
        shift = shifts[split:].mean(axis=0) - shifts[:split].mean(axis=0)
        turn = turns[split:].mean(axis=0) - turns[:split].mean(axis=0)
    else:
        shift, turn = np.median(shifts, axis=0), np.median(turns, axis=0)
        noise = np.hypot(_spread(shifts) / np.sqrt(len(shifts)), prediction_sd_px)
        if np.linalg.norm(shift) < max(_MIN_BIAS_PX, _SIGMAS * noise):
            return None
    size, angle = float(np.linalg.norm(shift)), float(np.degrees(np.linalg.norm(turn)))
    others_deviation = float(np.mean([row.others_deviation for row in kept]))
    return CameraMisfit(camera.name, size, angle, since, len(kept)), others_deviation


def _difference(
    camera: Camera, sample: SearchSample, body: Body, cameras: Sequence[Camera]
) -> _Difference | None:
    """Detected minus predicted; None if too few balls were seen, or their differences disagree."""
    by_name = {c.name: c for c in cameras}
    own = [d for d in sample.nearest if d.camera == camera.name]
    others = [d for d in sample.nearest if d.camera != camera.name and d.camera in by_name]
    if len(own) < 2 or len(others) < 4 or sample.world_from_body is None:
        return None
    try:
        seen = PoseObservations.of(others, body, by_name, sample.time_s, _SYSTEMATIC_PX)
        fit = fit_pose(sample.world_from_body, seen, sample.velocity)
    except DegenerateGeometryError:
        return None
    mine = PoseObservations.of(own, body, by_name, sample.time_s)
    residuals, by_body, _ = mine.residuals(fit.world_from_body, sample.velocity)
    middle = residuals.mean(axis=0)
    apart = np.max(np.linalg.norm(residuals - middle, axis=1))
    if not apart < _MAX_SPREAD_PX + _MAX_SPREAD_RATIO * np.linalg.norm(middle):  # one is hidden
        return None
    _, _, by_pose, _ = camera.project_with_jacobians(fit.world_from_body.apply(mine.points_body))
    # The least rotation: partly hidden balls do not determine one about the line of sight.
    turn = np.linalg.lstsq(by_pose[:, :, 3:].mean(axis=0), np.median(residuals, axis=0))[0]
    together = by_body.mean(axis=0)
    variance = np.linalg.eigvalsh(together @ fit.covariance @ together.T)[-1]
    off = float(np.mean(np.minimum(np.sqrt(fit.distances), _MAX_SIGMAS)))
    shift = np.median(residuals, axis=0)
    return _Difference(sample.time_s, shift, turn, float(np.sqrt(variance)), off)


def _step(shifts: Floats, prediction_sd_px: float) -> int | None:
    """The index of a step in (k, 2), by least absolute deviations; None if none is significant."""
    splits = range(_MIN_INSTANTS, len(shifts) - _MIN_INSTANTS + 1)
    if not splits:
        return None

    def left(split: int) -> float:
        parts = shifts[:split], shifts[split:]
        return float(sum(np.sum(np.abs(part - np.median(part, axis=0))) for part in parts))

    split = min(splits, key=left)
    before, after = shifts[:split], shifts[split:]
    step = float(np.linalg.norm(np.median(after, axis=0) - np.median(before, axis=0)))
    noise = np.hypot(_spread(before) / np.sqrt(len(before)), _spread(after) / np.sqrt(len(after)))
    noise = float(np.hypot(noise, prediction_sd_px))
    return split if step > max(_MIN_STEP_PX, _SIGMAS * noise) else None


def _spread(shifts: Floats) -> float:
    """Robust standard deviation of (k, 2) about their median, with a floor."""
    off = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    return max(0.1, 1.2 * float(np.median(off)))
