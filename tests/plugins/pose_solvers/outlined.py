"""BallRows as their outlines show them, and the pose that `contours` makes of those."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform, tangent_cone
from measure.model import Detection
from measure_plugins.pose_solvers.contours import ContoursConfig, ContoursSolver

POSE = RigidTransform.from_rotvec([0.1, -0.2, 0.3], [5.0, -8.0, 247.0])
OFF = np.array([0.8, -0.6, 0.5, 0.01, -0.012, 0.008])
ANGLES = np.linspace(0, 2 * np.pi, 60, endpoint=False)


def see(body, camera, name, pose, sd=0.05, rng=None, offset=0.0, shift=(0, 0), angles=ANGLES):
    """An exact outline, with noise and an offset along its normals, as a detection."""
    ball = body.balls[body.index(name)]
    center = camera.camera_from_world.apply(pose.apply(ball.center_mm))
    cone = tangent_cone(center, ball.radius_mm)
    points = camera.intrinsics.project(cone.bearings(angles))
    wider = camera.intrinsics.project(
        type(cone)(cone.axis, cone.half_angle + 1e-4).bearings(angles)
    )
    normals = (wider - points) / np.linalg.norm(wider - points, axis=1, keepdims=True)
    along = np.full(len(points), offset)
    if rng is not None:
        along = along + sd * rng.standard_normal(len(points))
    points = points + along[:, None] * normals + np.asarray(shift)
    return Detection(
        name,
        camera.name,
        0.0,
        camera.intrinsics.project(center[None])[0],
        60.0,
        0.01 * np.eye(2),
        outline_px=points,
        outline_sd_px=np.full(len(points), sd),
    )


def see_all(body, cameras, pose, skip=(), **kwargs):
    return [
        see(body, camera, name, pose, **kwargs)
        for camera in cameras.values()
        for name in body.names
        if (camera.name, name) not in skip
    ]


def solve(body, detections, cameras, prior=None, **config):
    return ContoursSolver(ContoursConfig(**config), body).solve([], detections, cameras, 0.0, prior)
