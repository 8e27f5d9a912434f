"""Parts of scenes, and the scenes of the demonstration and of the conformance kit."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Body, Camera, Intrinsics, paper_body
from measure.simulation.scene import (
    Capsule,
    Cuboid,
    Lamp,
    Lighting,
    Material,
    MotionLimits,
    Rgb,
    Scene,
    Shape,
    Sines,
    random_motion,
)
from measure.simulation.sensor import CameraSensor

WORKSPACE_MM = np.array([0.0, 0.0, 250.0])
"""The middle of the workspace; the world's origin is on the floor below it."""
PLASTIC = Material((1.0, 1.0, 1.0), 0.04, 0.06)


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


def plain_lighting(seed: int = 1) -> Lighting:
    """Two lamps and as much ambient light as a lit room gives."""
    return Lighting(lamps(seed), (0.2, 0.2, 0.2), (0.15, 0.15, 0.15))


_FLAT_MM = 20.0


def room(
    floor: Material, walls: tuple[Material, ...], half_mm: float = 1400.0, height_mm: float = 2400.0
) -> tuple[Shape, ...]:
    """A floor at z = 0 and four walls; the wall materials repeat cyclically."""
    ground = RigidTransform(np.eye(3), np.array([0.0, 0.0, -_FLAT_MM / 2]))
    shapes: list[Shape] = [Cuboid(ground, (4 * half_mm, 4 * half_mm, _FLAT_MM), floor)]
    for k in range(4):
        turn = RigidTransform.from_rotvec([0.0, 0.0, k * np.pi / 2])
        place = RigidTransform(np.eye(3), np.array([half_mm, 0.0, height_mm / 2 - 100]))
        size = (_FLAT_MM, 2 * half_mm, height_mm)
        shapes.append(Cuboid(turn @ place, size, walls[k % len(walls)]))
    return tuple(shapes)


def cloth_room(level: float, seed: int = 0) -> tuple[Shape, ...]:
    """Floor and walls hung with cloth of one reflectance."""
    return room(cloth(level, seed), (cloth(level, seed + 1), cloth(1.2 * level, seed + 2)))


def cloth(level: float, seed: int = 0, unevenness: float = 0.35) -> Material:
    """A grey cloth with soft folds."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 1 / 180, (12, 3)) * rng.uniform(0.3, 3, (12, 1))
    phases = rng.uniform(0, 2 * np.pi, 12)

    def texture(points: Floats) -> Floats:
        folds = np.sin(points @ waves.T + phases).sum(axis=1) / np.sqrt(12)
        grey = level * (1 + unevenness * np.clip(folds, -1.5, 1.5) / 1.5)
        return np.repeat(grey[:, None], 3, axis=1)

    return Material((level, level, level), texture=texture)


WEBCAM = CameraSensor(
    blur_px=0.6, bayer=True, electrons=9000.0, read_noise=11.0, quality=90, chroma="420"
)
"""Mosaic, noise and JPEG like a webcam's; the tone curve is sRGB."""
PLAIN_CAMERA = CameraSensor(blur_px=0.7, level_noise=2.0, encoding="png")
"""Blur, sRGB and noise of two levels, nothing else: the response is known."""


def motion(seed: int, limits: MotionLimits | None = None) -> Sines:
    """A smooth random motion about the middle of the workspace."""
    return random_motion(seed, RigidTransform(np.eye(3), WORKSPACE_MM), limits)


def webcam_scene(seed: int = 1) -> Scene:
    """Glossy balls before black cloth, synchronised webcams, no motion blur."""
    body = paper_body()
    return Scene(
        "still",
        body,
        paper_rig(),
        motion(seed),
        Lighting(lamps(seed), (0.15, 0.15, 0.15), (0.12, 0.12, 0.12), shadows=True),
        finish=PLASTIC,
        attached=(*stems(body), shaft(color=(0.02, 0.02, 0.02))),
        backdrop=cloth_room(0.02, seed),
        sensor=WEBCAM,
        seed=seed,
        description="glossy balls before black cloth, webcam pictures",
    )


def plain_scene(background: str = "black", seed: int = 1) -> Scene:
    """The simplest sensor chain, of known response, before black or grey cloth.

    Grey stems, two lamps, no mosaic, no JPEG.
    """
    body = paper_body()
    return Scene(
        f"plain-{background}",
        body,
        paper_rig(),
        motion(seed + 100),
        plain_lighting(seed),
        finish=Material((1.0, 1.0, 1.0), 0.03, 0.08),
        attached=stems(body, (0.18, 0.18, 0.18)),
        backdrop=cloth_room({"black": 0.01, "grey": 0.12}[background], seed),
        sensor=PLAIN_CAMERA,
        seed=seed,
        description=f"{background} background; blur, sRGB and noise only",
    )
