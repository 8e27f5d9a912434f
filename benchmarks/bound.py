"""The Cramér-Rao bound of a pose: what pixel noise alone allows, given contrast and blur.

A blurred step of contrast C under noise of standard deviation s tells, per px of outline,
(C / s)^2 / (2 sqrt(pi) b) about where it lies along its normal, b being the blur's sigma; the
contrast is the length of the inside-minus-outside colour. Summed over all visible outline, through
how the pose moves it, that is the pose's Fisher information. Nothing real comes near the bound:
errors of edges are systematic, not noise.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform, skew
from measure.model import Body, Camera, FrameSet, Image
from measure.session import Trajectory
from measure_plugins._outline.appearance import balls_nearer
from measure_plugins._outline.rays import (
    CLEAR,
    cast_rays,
    frame_about,
    levels,
    mark_occluded,
    sample,
)

BLUR_PX = 0.76
"""Optics of 0.7 px and the pixel's own width."""
_RAYS = 72
_STEPS = np.arange(-6.0, 6.51, 0.5)
_INSIDE_PX, _OUTSIDE_PX = (-6.0, -3.0), (3.0, 6.5)
_QUANTISATION = 1 / 255 / np.sqrt(12)
_VALUES = np.arange(256) / 255.0


def pose_bound(
    body: Body, cameras: tuple[Camera, ...], frame_set: FrameSet, truth: Trajectory, time_s: float
) -> Floats:
    """The least covariance (6, 6) any estimator of this frame set's pose can have."""
    information = np.zeros((6, 6))
    pose = truth.at(np.array([time_s]))[0]
    for camera in cameras:
        image = frame_set.images.get(camera.name)
        if image is not None:
            place = truth.at(np.array([image.time_s]))[0]
            information += _of_image(body, camera, image, place, pose)
    return np.asarray(np.linalg.inv(information))


def _of_image(
    body: Body, camera: Camera, image: Image, place: RigidTransform, pose: RigidTransform
) -> Floats:
    centers = camera.camera_from_world.apply(place.apply(body.centers))
    distances = np.linalg.norm(centers, axis=1)
    axes = centers / distances[:, None]
    angles = np.arcsin(np.array([ball.radius_mm for ball in body.balls]) / distances)
    cones, noise = np.column_stack([axes, angles, distances]), _noise(image)
    turn = camera.camera_from_world.rotation
    out = np.zeros((6, 6))
    for k in range(len(body.balls)):
        nearer = balls_nearer(cones[k], cones)
        rows, weights = _rays(camera, image, axes[k], float(angles[k]), nearer)
        by_center = rows / distances[k]
        arm = pose.rotate(body.balls[k].center_mm)
        by_pose = by_center @ np.hstack([turn, -turn @ skew(arm)])
        out += (by_pose * (weights / noise**2)[:, None]).T @ by_pose
    return out


def _rays(
    camera: Camera, image: Image, axis: Floats, half_angle: float, nearer: Floats
) -> tuple[Floats, Floats]:
    """How the outline moves, px by rad of its centre's direction (n, 3), and C^2 b' ds (n,)."""
    lens, frame = camera.intrinsics.row, frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, _RAYS, lens)
    reach = (_INSIDE_PX[0], _OUTSIDE_PX[1])
    mark_occluded(rays, scale, frame, half_angle, nearer, reach, 0.0)
    pixels = np.ascontiguousarray(image.pixels)
    no_light = np.zeros(len(_STEPS), np.bool_)
    _, values = sample(pixels, _VALUES, rays, _STEPS, no_light, 0)
    contrast = levels(values, _STEPS, _INSIDE_PX) - levels(values, _STEPS, _OUTSIDE_PX)
    length = np.linalg.norm(np.roll(rays.points, -1, axis=0) - rays.points, axis=1)
    told = np.sum(contrast**2, axis=0) / (2 * np.sqrt(np.pi) * BLUR_PX) * length
    outward = rays.around @ frame[:2]
    rows = scale[:, None] * (outward - np.tan(half_angle) * axis)
    return rows, np.where(rays.status == CLEAR, told, 0.0)


def _noise(image: Image) -> float:
    """Standard deviation of a picture value, 0 to 1, per channel: from second differences.

    The median of absolute values passes over edges; eight bits are coarse, whatever they show.
    """
    values = image.pixels[::2, ::2].astype(np.float64) / 255
    second = values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]
    return max(float(np.median(np.abs(second))) / 0.6745 / np.sqrt(6), _QUANTISATION)
