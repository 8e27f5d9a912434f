"""What ideal cameras see of balls that hide each other or stand behind something; no pixels."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.model import Detection
from tests.scenes import RAVEN, TARGET, a_pose

_ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False)
_LEAST_VISIBLE = 0.25


def outline(eye, center, radius):
    """Points (48, 3) of a sphere's outline as seen from `eye`."""
    away = center - eye
    distance = np.linalg.norm(away)
    forward = away / distance
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    across = np.cos(_ANGLES)[:, None] * right + np.sin(_ANGLES)[:, None] * np.cross(forward, right)
    return (
        center
        - forward * radius**2 / distance
        + radius * np.sqrt(1 - (radius / distance) ** 2) * across
    )


def hidden(eye, points, spheres):
    """Whether something stands between `eye` and each of the points (n, 3)."""
    rays = points - eye
    lengths = np.linalg.norm(rays, axis=1)
    rays = rays / lengths[:, None]
    out = np.zeros(len(points), bool)
    for center, radius in spheres:
        along = rays @ (center - eye)
        off = np.linalg.norm(eye + along[:, None] * rays - center, axis=1)
        out |= (off < radius) & (along > 0) & (along < lengths - 1e-3)
    return out


def seen(cameras, balls, rng, blobs=()):
    """Detections by camera of balls [(name, center, radius)], hidden by each other and by blobs."""
    out = {name: [] for name in cameras}
    for name, camera in cameras.items():
        for k, (ball, center, radius) in enumerate(balls):
            pixel = camera.project(center[None])[0]
            if not camera.intrinsics.contains(pixel[None])[0]:
                continue
            others = [(c, r) for j, (_, c, r) in enumerate(balls) if j != k]
            points = outline(camera.center, center, radius)
            visible = 1 - np.mean(hidden(camera.center, points, [*others, *blobs]))
            if visible < _LEAST_VISIBLE:
                continue
            sd = (0.15 if visible > 0.5 else 0.6) / visible
            distance = np.linalg.norm(center - camera.center)
            apparent = camera.intrinsics.focal_px * np.tan(np.arcsin(radius / distance))
            out[name].append(
                Detection(
                    ball,
                    name,
                    0.0,
                    pixel + rng.normal(scale=sd, size=2),
                    float(apparent * (1 + rng.normal(scale=0.01 / visible))),
                    sd**2 * np.eye(2),
                    score=float(visible),
                    color_match=1.0,
                )
            )
    return out


def balls_of(pose, body=RAVEN):
    """As `seen` wants them."""
    return [(b.name, pose.apply(b.center_mm), b.radius_mm) for b in body.balls]


def two_bodies(rng, most_blobs):
    """Poses of two bodies 50 to 200 mm apart that do not touch, and blobs that hide the first."""
    while True:
        first = a_pose(rng, 25, 60)
        aside = rng.normal(size=3)
        aside *= rng.uniform(50, 200) / np.linalg.norm(aside)
        second = RigidTransform.from_rotvec(rng.normal(size=3) * 0.6, first.translation + aside)
        between = first.apply(RAVEN.centers)[:, None] - second.apply(RAVEN.centers)[None]
        if np.min(np.linalg.norm(between, axis=2)) > 40:
            break
    middle = first.translation - aside / np.linalg.norm(aside) * rng.uniform(0, 40)
    blobs = [
        (middle + rng.normal(size=3) * 25, rng.uniform(8, 35))
        for _ in range(rng.integers(0, most_blobs + 1))
    ]
    return first, second, blobs


def lone_balls(rng, body=RAVEN, count=4):
    """Balls of the body's colours about the workspace, of about its size, that are not its own."""
    out = []
    for _ in range(count):
        aside = rng.normal(size=3)
        place = TARGET + aside * rng.uniform(110, 350) / np.linalg.norm(aside)
        out.append((body.names[rng.integers(3)], place, 20.0 * rng.uniform(0.8, 1.15)))
    return out
