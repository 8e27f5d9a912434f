"""Bringing what was seen at different times to one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats, stacked
from measure.measuring.pose_fit import Sightings
from measure.model import BallView, Body, Camera, Detection, Motion, Pose, Rig

_COMMON_PX = 0.3
"""What a detection is off by besides its noise: it makes all of them count about alike."""


def detections_at(
    detections: Sequence[Detection],
    time_s: float,
    motion: Motion,
    body: Body,
    cameras: Mapping[str, Camera],
) -> list[Detection]:
    """The detections as they would have been at `time_s`, by the body's predicted motion.

    Only the centres are moved; outline points stay as they were seen. To first order the error of
    the prediction's *position* cancels, only that of its velocity counts.
    """
    late = [d for d in detections if d.time_s != time_s]
    if not late:
        return list(detections)
    then = _projected(late, [d.time_s for d in late], motion, body, cameras)
    now = _projected(late, [time_s] * len(late), motion, body, cameras)
    moved = {
        id(d): replace(d, center_px=d.center_px + shift, time_s=time_s)
        for d, shift in zip(late, now - then, strict=True)
    }
    return [moved.get(id(d), d) for d in detections]


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
    seen = [view.detection for view in views if view.effective and view.detection is not None]
    if not seen:
        return {}
    predicted = _projected(seen, [d.time_s for d in seen], motion, body, cameras)
    return {
        (d.ball, d.camera): d.center_px - pixel for d, pixel in zip(seen, predicted, strict=True)
    }


def pose_residuals(
    views: Sequence[BallView],
    pose: Pose,
    prior: Motion | None,
    body: Body,
    cameras: Mapping[str, Camera],
) -> dict[tuple[str, str], Floats]:
    """`center_residuals` of a pose that moves as `prior` says; of one at rest without a prior."""
    if prior is None:
        motion = Motion.at_rest(pose.world_from_body, pose.time_s)
    else:
        motion = replace(prior, world_from_body=pose.world_from_body, time_s=pose.time_s)
    return center_residuals(views, motion, body, cameras)


def velocity_share(
    detections: Sequence[Detection],
    pose: Pose,
    motion: Motion,
    body: Body,
    cameras: Mapping[str, Camera],
) -> Floats:
    """What an uncertain velocity, and none that changes, add to the covariance (6, 6) of a pose.

    A motion that is wrong carries the pictures of different times to different places, and the
    pose to their weighted mean.
    """
    if motion.velocity_covariance is None or len({d.time_s for d in detections}) < 2:
        return np.zeros((6, 6))
    seen = Sightings.of(detections, body, cameras, pose.time_s, _COMMON_PX)
    _, by_pose, by_velocity = seen.residuals(pose.world_from_body, motion.velocity)
    gain = np.swapaxes(by_pose, 1, 2) @ np.linalg.inv(seen.noise)
    normal = (gain @ by_pose).sum(axis=0)
    by_bend = by_velocity * (seen.lead_s / 2)[:, None, None]
    moved = np.hstack([(gain @ by_velocity).sum(axis=0), (gain @ by_bend).sum(axis=0)])
    # One ball alone leaves a turn open: its pose is the prediction's, whatever the velocity.
    lever, bend = np.hsplit(np.linalg.lstsq(normal, moved, rcond=1e-9)[0], 2)
    out = lever @ motion.velocity_covariance @ lever.T
    if motion.acceleration_square is not None:
        out = out + bend @ motion.acceleration_square @ bend.T
    return np.asarray(out)


def _projected(
    seen: Sequence[Detection],
    times_s: Sequence[float],
    motion: Motion,
    body: Body,
    cameras: Mapping[str, Camera],
) -> Floats:
    """Pixels (n, 2) of the detections' balls, in their cameras, with the body at `times_s`."""
    poses = {time_s: motion.at(time_s) for time_s in dict.fromkeys(times_s)}
    balls = {time_s: pose.apply(body.centers) for time_s, pose in poses.items()}
    centers = [balls[t][body.index(d.ball)] for d, t in zip(seen, times_s, strict=True)]
    return Rig.of([cameras[d.camera] for d in seen]).project(stacked(centers))[0]
