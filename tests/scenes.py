"""Ideal cameras and bodies for tests: what a perfect detector would report, plus known noise."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.model import Ball, BallColor, Body, Camera, Detection, Intrinsics

RAVEN = Body(
    "raven",
    (
        Ball("green", BallColor.named("green"), np.array([38.0, 0, 0]), 20.0),
        Ball("yellow", BallColor.named("yellow"), np.array([0, 38.0, 0]), 20.0),
        Ball("red", BallColor.named("red"), np.array([-38.0, 0, 0]), 20.0),
    ),
)
FOUR = Body(
    "four",
    (
        Ball("white", BallColor.named("white"), np.array([30.0, 0, 0]), 15.0),
        Ball("blue", BallColor.named("blue"), np.array([0, 42.0, 5.0]), 15.0),
        Ball("orange", BallColor.named("orange"), np.array([-33.0, -8.0, 0]), 15.0),
        Ball("green", BallColor.named("green"), np.array([4.0, -6.0, 36.0]), 15.0),
    ),
)
TARGET = np.array([0.0, 0.0, 250.0])
SIZE_WH = (1280, 720)
LENS = np.array([0.06, -0.12, 0.001, -0.0007, 0.03])


def look_at(center, target=TARGET):
    """World pose of a camera at `center` that looks at `target`, image up towards world z."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), center)


def ring(count=4, distance=450.0, elevation_deg=25.0, pose_covariance=None, focal=1420.0):
    """Cameras around the target."""
    cameras = []
    for i in range(count):
        azimuth, up = np.radians(45 + 360 * i / count), np.radians(elevation_deg)
        away = [np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)]
        matrix = np.array([[focal, 0, 640.0 + i], [0, focal + 2, 360.0 - i], [0, 0, 1]])
        cameras.append(
            Camera(
                f"cam{i}",
                Intrinsics(SIZE_WH, matrix, LENS * (-1) ** i),
                look_at(TARGET + distance * np.array(away)),
                pose_covariance,
            )
        )
    return {camera.name: camera for camera in cameras}


def displaced(body, ball, offset_mm):
    """The same body with one ball elsewhere."""
    return body.with_centers(body.centers + np.outer(np.array(body.names) == ball, offset_mm))


def moved(camera, pose):
    """The same camera standing elsewhere."""
    return Camera(camera.name, camera.intrinsics, pose, camera.pose_covariance)


def strayed(cameras, rng):
    """The cameras where they really are: off by what is stated of their poses."""
    off = {n: rng.multivariate_normal(np.zeros(6), c.pose_covariance) for n, c in cameras.items()}
    return {n: moved(c, c.world_from_camera.perturb(off[n])) for n, c in cameras.items()}


def a_pose(rng, shift=25.0, turn_deg=30.0):
    """A random pose of the body in the workspace."""
    axis = rng.normal(size=3)
    rotvec = axis / np.linalg.norm(axis) * np.radians(turn_deg) * rng.uniform(0, 1)
    return RigidTransform.from_rotvec(rotvec, TARGET + rng.uniform(-shift, shift, 3))


def see(cameras, body, world_from_body, sd_px=0.1, rng=None, time_s=0.0, skip=()):
    """Detections of every ball in every camera; `world_from_body` may be a function of time."""
    out = []
    for number, camera in enumerate(cameras.values()):
        own_time = time_s[number] if np.ndim(time_s) else time_s
        pose = world_from_body(own_time) if callable(world_from_body) else world_from_body
        centers = pose.apply(body.centers)
        pixels = camera.project(centers)
        depths = np.linalg.norm(centers - camera.center, axis=1)
        for ball, pixel, depth in zip(body.balls, pixels, depths, strict=True):
            if (ball.name, camera.name) in skip or not np.all(np.isfinite(pixel)):
                continue
            noise = np.zeros(2) if rng is None else rng.normal(scale=sd_px, size=2)
            radius = camera.intrinsics.focal_px * np.tan(np.arcsin(ball.radius_mm / depth))
            out.append(
                Detection(
                    ball.name,
                    camera.name,
                    float(own_time),
                    pixel + noise,
                    float(radius),
                    sd_px**2 * np.eye(2),
                    color_match=1.0,
                )
            )
    return out


def of_ball(detections, name):
    """The detections of one ball."""
    return [d for d in detections if d.ball == name]
