"""How well the body's position can be known across the workspace of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.estimation.expected_accuracy import body_pose_sd, noise_sd, tolerance_sd
from measure.geometry import RigidTransform
from measure.limits import SPREAD_OVER
from measure.results.run import Run

_STEPS = 11
_MIN_REACH_MM = 60.0
_MAP_SIZE_RATIO = 1.5  # How far the map goes beyond the places where the body was


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Expected error of the body's position over a plane through the middle of the workspace."""

    axes: tuple[int, int]  # the two world axes of the plane: 0 is x, 1 y, 2 z
    across_mm: Floats  # (n,) coordinates along the first
    up_mm: Floats  # (m,) along the second
    sd_mm: Floats  # (m, n) standard deviation of the position, 3-D; NaN where it cannot be measured
    from_calibration: bool  # whether the cameras' own uncertainty is in it


def accuracy_map(run: Run, axes: tuple[int, int]) -> AccuracyMap:
    """What one may expect elsewhere in the workspace, with every ball in sight.

    The geometry of cameras and body says how errors grow from place to place; how large they are is
    what the run, with at least one pose, reported along its path, and the calibration's part
    (camera by camera) is kept apart from that of the pictures. The body keeps the turn it had in
    the middle of the run.
    """
    place = run.world_from_body.translation
    low, high = place.min(axis=0), place.max(axis=0)
    middle = (low + high) / 2
    reach = np.maximum(_MAP_SIZE_RATIO * (high - low) / 2, _MIN_REACH_MM)
    turn = run.world_from_body.rotation[len(place) // 2]
    steps = np.linspace(-1, 1, _STEPS)
    across, up = (middle[axis] + reach[axis] * steps for axis in axes)
    noise_px = reported_noise_px(run)
    sd = np.empty((_STEPS, _STEPS))
    for row, column in np.ndindex(sd.shape):
        at = middle.copy()
        at[list(axes)] = across[column], up[row]
        per_px, fixed = _parts(RigidTransform(turn, at), run)
        sd[row, column] = np.hypot(noise_px * per_px, fixed)
    known = any(camera.pose_covariance is not None for camera in run.cameras)
    return AccuracyMap(axes, across, up, sd, known)


def reported_noise_px(run: Run) -> float:
    """The noise of a ball's centre in a picture that explains the uncertainty the run reported.

    Larger than the scatter of the outlines, because the reported uncertainty also holds what no
    single frame can show. The median over poses spread along the run.
    """
    picked = np.unique(np.linspace(0, int(run.has_pose.sum()) - 1, SPREAD_OVER).astype(int))
    reported = np.sqrt(np.trace(run.covariances[picked, :3, :3], axis1=1, axis2=2))
    parts = np.array([_parts(run.world_from_body[int(k)], run) for k in picked])
    seen = np.isfinite(parts).all(axis=1)
    if not seen.any():
        return float("nan")
    beside = np.maximum(reported**2 - parts[:, 1] ** 2, 0.0)[seen]
    return float(np.sqrt(np.median(beside / parts[seen, 0] ** 2)))


def _parts(pose: RigidTransform, run: Run) -> tuple[float, float]:
    """SD of the position in mm by a px of noise, and by calibration and body; NaN if unseen."""
    points = pose.apply(run.body.centers)
    cameras = tuple(c for c in run.cameras if c.intrinsics.contains(c.project(points)).any())
    per_px, _ = noise_sd(pose, run.body, cameras, 1.0)
    if not np.isfinite(per_px):
        return float("nan"), float("nan")
    from_cameras, _ = body_pose_sd(cameras, run.body, [pose])
    from_body, _ = tolerance_sd(run.body, pose)
    return per_px, math.hypot(from_cameras[0], from_body)
