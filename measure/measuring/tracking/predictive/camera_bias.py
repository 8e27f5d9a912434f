"""Cameras that see all balls aside: moved, by a wrong clock, or as far as is to be expected.

A fit gives way to a camera that is off, and its residuals stay small; but they have a direction in
common.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile, propagate, squared_mahalanobis
from measure.measuring.tracking.predictive.pose_checks import cameras_at_odds
from measure.model import BallView, Body, Camera, Motion, Pose, Rig

_MANY = 2
_WARY = 10
"""Frame sets after one in which a camera contradicts the others on every ball."""


class CamerasAside:
    """Tells them, frame set by frame set.

    Calibration and motion explain some of it. Motion explains nothing while cameras contradict each
    other: of one that was moved, a body that is shaken hides it from time to time.
    """

    def __init__(
        self, body: Body, cameras: Sequence[Camera], view_bias_px: float, confidence: float
    ) -> None:
        """See the tracker's settings."""
        self._body, self._cameras = body, {camera.name: camera for camera in cameras}
        self._view_bias_px, self._gate = view_bias_px, chi_square_quantile(confidence, 2)
        self._wary = 0

    def doubts(
        self,
        pose: Pose,
        views: Sequence[BallView],
        residuals_px: Mapping[tuple[str, str], Floats],
        motion: Callable[[], Motion | None],
    ) -> tuple[str, ...]:
        """A line for each of them.

        Args:
            pose: the pose.
            views: what was seen, and what of it is believed.
            residuals_px: (2,) of every believed sighting, by (ball, camera).
            motion: tells the motion by which pictures were brought together; rarely asked.
        """
        self._wary = _WARY if cameras_at_odds(views) else max(self._wary - 1, 0)
        found: tuple[str, ...] = ()
        for name, shared in _shared(views, residuals_px, self._view_bias_px).items():
            aside_px, variance, time_s = shared
            if aside_px @ aside_px <= self._gate * variance:
                continue
            moving = motion() if self._wary == 0 else None
            explained = _explained(self._cameras[name], pose, self._body, time_s, moving)
            if squared_mahalanobis(aside_px, variance * np.eye(2) + explained) > self._gate:
                text = f"camera {name} sees all balls {math.hypot(*aside_px):.1f} px aside"
                found += (f"{text}: was it moved, or is its clock off?",)
        return found


def _shared(
    views: Sequence[BallView], residuals_px: Mapping[tuple[str, str], Floats], view_bias_px: float
) -> dict[str, tuple[Floats, float, float]]:
    """What the balls of a camera have in common: a shift (2,), its variance per axis, the time."""
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
        if count >= _MANY
    }


def _explained(
    camera: Camera, pose: Pose, body: Body, time_s: float, motion: Motion | None
) -> Floats:
    """Covariance (2, 2) of a shift that calibration, body and motion leave open, px^2.

    Pictures are brought together by a constant velocity, which is uncertain, and changes.
    """
    arm = pose.world_from_body.rotate(body.middle)
    place, rig = pose.world_from_body.translation + arm, Rig.of((camera,))
    by_place = rig.project(place)[1][0]
    noise = calibration_noise(rig, place)[0] + propagate(by_place, body.center_covariance)
    if motion is None or motion.velocity_covariance is None:
        return noise
    lead_s = time_s - pose.time_s
    by_pose = np.hstack([by_place, np.cross(arm, by_place)])
    left_out = lead_s**2 * motion.velocity_covariance
    if motion.acceleration_square is not None:
        left_out = left_out + lead_s**4 / 4 * motion.acceleration_square
    return noise + propagate(by_pose, left_out)
