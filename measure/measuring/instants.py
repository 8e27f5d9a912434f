"""Bringing what was seen at different times to one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.measuring.pose_fit import Sightings
from measure.model import BallView, Body, Camera, Detection, Motion, Pose

_COMMON_PX = 0.3
"""What a detection is off by besides its noise: it makes all of them count about alike."""


def detection_at(
    detection: Detection, time_s: float, motion: Motion, body: Body, cameras: Mapping[str, Camera]
) -> Detection:
    """The detection as it would have been at `time_s`, by the body's predicted motion.

    Only the centre is moved; outline points stay as they were seen. To first order the error of the
    prediction's *position* cancels, only that of its velocity counts.
    """
    camera = cameras[detection.camera]
    center = body.balls[body.index(detection.ball)].center_mm
    then, now = motion.at(detection.time_s).apply(center), motion.at(time_s).apply(center)
    before, after = camera.project([then, now])
    return replace(detection, center_px=detection.center_px + (after - before), time_s=time_s)


def center_residuals(
    views: Sequence[BallView], motion: Motion, body: Body, cameras: Mapping[str, Camera]
) -> dict[tuple[str, str], Floats]:
    """Detected minus predicted sphere centre (2,) in px of every effective view, by (ball, camera).

    Args:
        views: of one frame set.
        motion: the measured pose, with the velocity that carries it to each image's own time.
        body: the body.
        cameras: by name.
    """
    residuals = {}
    for view in views:
        if view.effective and view.detection is not None:
            center = body.balls[body.index(view.ball)].center_mm
            there = motion.at(view.detection.time_s).apply(center)
            predicted = cameras[view.camera].project(there[None])[0]
            residuals[view.ball, view.camera] = view.detection.center_px - predicted
    return residuals


def velocity_share(
    detections: Sequence[Detection],
    pose: Pose,
    motion: Motion,
    body: Body,
    cameras: Mapping[str, Camera],
) -> Floats:
    """What an uncertain velocity adds to the covariance (6, 6) of a pose.

    A velocity that is wrong carries the pictures of different times to different places, and the
    pose to their weighted mean.
    """
    if motion.velocity_covariance is None or len({d.time_s for d in detections}) < 2:
        return np.zeros((6, 6))
    seen = Sightings.of(detections, body, cameras, pose.time_s, _COMMON_PX)
    _, by_pose, by_velocity = seen.residuals(pose.world_from_body, motion.velocity)
    gain = np.swapaxes(by_pose, 1, 2) @ np.linalg.inv(seen.noise)
    normal = (gain @ by_pose).sum(axis=0)
    # One ball alone leaves a turn open: its pose is the prediction's, whatever the velocity.
    lever = np.linalg.lstsq(normal, (gain @ by_velocity).sum(axis=0), rcond=1e-9)[0]
    return np.asarray(lever @ motion.velocity_covariance @ lever.T)
