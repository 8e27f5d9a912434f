"""Cameras whose residuals share an offset: moved, with a wrong clock, or within the uncertainty.

A fit adapts to a camera with a bias, so the residuals stay small; but all its balls share their
direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile, propagate, squared_mahalanobis
from measure.measuring.tracking.predictive.pose_checks import contradicting_cameras
from measure.model import BallView, Body, Camera, Motion, Pose, Rig

_MIN_BALLS = 2
_HOLD_FRAME_SETS = 10
"""Frame sets, after cameras contradicted each other, in which motion explains no offset."""


class CameraBiasMonitor:
    """Flags them, frame set by frame set.

    The uncertainties of calibration and motion explain a part of an offset. That of the motion does
    not count for some time after cameras contradicted each other: else a shaken body would hide
    from time to time that a camera was moved.
    """

    def __init__(
        self, body: Body, cameras: Sequence[Camera], view_bias_px: float, confidence: float
    ) -> None:
        """See the tracker's settings."""
        self._body, self._cameras = body, {camera.name: camera for camera in cameras}
        self._view_bias_px, self._gate = view_bias_px, chi_square_quantile(confidence, 2)
        self._hold = 0

    def flags(
        self,
        pose: Pose,
        views: Sequence[BallView],
        residuals_px: Mapping[tuple[str, str], Floats],
        motion: Callable[[], Motion | None],
    ) -> tuple[str, ...]:
        """One flag for each of them.

        Args:
            views: with effective and suspended detections.
            residuals_px: (2,) of every effective ball-view, by (ball, camera).
            motion: returns the motion by which detections were moved to one instant; rarely called.
        """
        self._hold = _HOLD_FRAME_SETS if contradicting_cameras(views) else max(self._hold - 1, 0)
        found: tuple[str, ...] = ()
        for name, offset in _offsets(views, residuals_px, self._view_bias_px).items():
            offset_px, variance, time_s = offset
            if offset_px @ offset_px <= self._gate * variance:
                continue
            moving = motion() if self._hold == 0 else None
            explained = _explained(self._cameras[name], pose, self._body, time_s, moving)
            if squared_mahalanobis(offset_px, variance * np.eye(2) + explained) > self._gate:
                text = f"camera {name} sees all balls {math.hypot(*offset_px):.1f} px aside"
                found += (f"{text}: was it moved, or is its clock off?",)
        return found


def _offsets(
    views: Sequence[BallView], residuals_px: Mapping[tuple[str, str], Floats], view_bias_px: float
) -> dict[str, tuple[Floats, float, float]]:
    """By camera: weighted mean residual (2,), its variance per axis, and the image's time."""
    sums: dict[str, tuple[int, float, float, float, float]] = {}
    for view in views:
        off_px = residuals_px.get((view.ball, view.camera))
        if view.effective and view.detection is not None and off_px is not None:
            weight, (u, v) = 1 / (view.detection.variance_px2 + view_bias_px**2), off_px.tolist()
            count, total, x, y, _ = sums.get(view.camera, (0, 0.0, 0.0, 0.0, 0.0))
            now = count + 1, total + weight, x + weight * u, y + weight * v
            sums[view.camera] = *now, view.detection.time_s
    return {
        camera: (np.array([x, y]) / total, 1 / total, time_s)
        for camera, (count, total, x, y, time_s) in sums.items()
        if count >= _MIN_BALLS
    }


def _explained(
    camera: Camera, pose: Pose, body: Body, time_s: float, motion: Motion | None
) -> Floats:
    """Covariance (2, 2) of an offset by the uncertainty of calibration, body and motion, px^2.

    Detections are moved to one instant by a constant velocity, which is uncertain and changes.
    """
    arm = pose.world_from_body.rotate(body.middle)
    place, rig = pose.world_from_body.translation + arm, Rig.of((camera,))
    by_place = rig.project(place)[1][0]
    noise = calibration_noise(rig, place)[0] + propagate(by_place, body.center_covariance)
    if motion is None or motion.velocity_covariance is None:
        return noise
    lead_s = time_s - pose.time_s
    by_pose = np.hstack([by_place, np.cross(arm, by_place)])
    by_motion = lead_s**2 * motion.velocity_covariance
    if motion.acceleration_square is not None:
        by_motion = by_motion + lead_s**4 / 4 * motion.acceleration_square
    return noise + propagate(by_pose, by_motion)
