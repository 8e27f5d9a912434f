"""Ready-made parts of scenes: cameras round a workspace, the paper's body, lamps."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Ball, BallColor, Body, Camera, Intrinsics
from measure.simulation.shading import Lamp, Lighting, Material, Rgb
from measure.simulation.shapes import Capsule, Shape

WORKSPACE_MM = np.array([0.0, 0.0, 250.0])
"""The middle of the workspace; the world's origin is on the floor below it."""
PLASTIC = Material((1.0, 1.0, 1.0), 0.04, 0.06)
MATT = Material((1.0, 1.0, 1.0), 0.0)


def body(name: str, balls: dict[str, tuple[float, float, float]], radius_mm: float) -> Body:
    """A body of balls named by their colour, at the given places in mm."""
    return Body(
        name, tuple(Ball(c, BallColor.named(c), np.array(p), radius_mm) for c, p in balls.items())
    )


def look_at(center_mm: Floats, target_mm: Floats) -> RigidTransform:
    """world_from_camera at a place, looking at a target, with the picture's top towards +Z."""
    forward = target_mm - center_mm
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(np.column_stack([right, np.cross(forward, right), forward]), center_mm)


def ring(
    count: int, seed: int = 1, distance_mm: float = 450.0, elevation_deg: float = 25.0
) -> tuple[Camera, ...]:
    """Cameras round the workspace at equal azimuths from 45 degrees, no two quite alike."""
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(count):
        azimuth = np.deg2rad(45 + 360 * k / count + rng.uniform(-4, 4))
        elevation = np.deg2rad(elevation_deg + rng.uniform(-3, 3))
        direction = np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )
        center = WORKSPACE_MM + (distance_mm + rng.uniform(-15, 15)) * direction
        pose = look_at(center, WORKSPACE_MM + rng.uniform(-8, 8, 3))
        cameras.append(Camera(f"cam{k}", _webcam(rng), pose))
    return tuple(cameras)


def paper_rig() -> tuple[Camera, ...]:
    """The paper's four webcams: 450 mm away, 90 degrees apart, 25 degrees up, f about 1420 px."""
    return ring(4)


def _webcam(rng: np.random.Generator) -> Intrinsics:
    """1280x720, f about 1420 px, mild distortion."""
    focal = 1420 + rng.uniform(-20, 20)
    sign = rng.choice([-1.0, 1.0])
    matrix = np.array(
        [
            [focal, 0, 639.5 + rng.uniform(-15, 15)],
            [0, focal + rng.uniform(-3, 3), 359.5 + rng.uniform(-15, 15)],
            [0, 0, 1],
        ]
    )
    radial = sign * np.array([rng.uniform(0.04, 0.08), -rng.uniform(0.08, 0.16)])
    tangential = rng.uniform(-0.0012, 0.0012, 2)
    return Intrinsics((1280, 720), matrix, np.array([*radial, *tangential, 0.0]))


def stems(of: Body, color: Rgb = (0.03, 0.03, 0.03), radius_mm: float = 3.0) -> tuple[Shape, ...]:
    """Rods from the body's origin to its balls."""
    material = Material(color, 0.04, 0.15)
    return tuple(Capsule(np.zeros(3), b.center_mm, radius_mm, material) for b in of.balls)


def shaft(up: bool = False, color: Rgb = (0.25, 0.25, 0.27), radius_mm: float = 6.5) -> Shape:
    """The instrument's shaft, along the body's z axis, downwards or upwards."""
    end = np.array([0.0, 0.0, 400.0 if up else -400.0])
    return Capsule(np.zeros(3), end, radius_mm, Material(color, 0.3, 0.12))


def lamps(
    seed: int = 1, count: int = 2, strength: float = 0.5, tint: Rgb = (1.0, 1.0, 1.0)
) -> tuple[Lamp, ...]:
    """Soft lamps overhead, about a metre away."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        azimuth = 2 * np.pi * (k + rng.uniform(0.1, 0.6)) / count
        place = WORKSPACE_MM + np.array(
            [700 * np.cos(azimuth), 700 * np.sin(azimuth), rng.uniform(600, 900)]
        )
        share = strength * rng.uniform(0.8, 1.2)
        r, g, b = tint
        out.append(Lamp(place, (share * r, share * g, share * b), rng.uniform(60, 120)))
    return tuple(out)


def plain_lighting(seed: int = 1, ambient: float = 0.2) -> Lighting:
    """Two lamps and as much ambient light as a lit room gives."""
    grey = (ambient, ambient, ambient)
    return Lighting(lamps(seed), grey, (0.15, 0.15, 0.15))
