"""The scenes that tests and benchmarks measure; each in one function call."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Ball, BallColor, Body, Camera, paper_body
from measure.simulation.catalogue import (
    WEBCAM,
    cloth_room,
    lamps,
    motion,
    plain_scene,
    ring,
    shaft,
    stems,
    webcam_scene,
)
from measure.simulation.scene import (
    BALL_ALBEDO,
    Capsule,
    Cuboid,
    Lighting,
    Material,
    MotionLimits,
    Scene,
    Shape,
    Sphere,
    painted,
)
from tests.simulated.mirroring import mirrored
from tests.simulated.rooms import coloured_room

MATT = Material((1.0, 1.0, 1.0), 0.0)
_OTHER_SEEDS = (11, 12, 13, 14)
"""Seeds of lamps, rooms, motions and noise that no scene of the catalogue has."""


def body(name: str, balls: dict[str, tuple[float, float, float]], radius_mm: float) -> Body:
    """A body of balls named by their colour, at the given places in mm."""
    return Body(
        name, tuple(Ball(c, BallColor.named(c), np.array(p), radius_mm) for c, p in balls.items())
    )


def four_ball_body() -> Body:
    """Another body: four balls of radius 15 mm, white among them, not in one plane."""
    places = {
        "white": (34.0, 6.0, -4.0),
        "blue": (-8.0, 33.0, 6.0),
        "orange": (-31.0, -9.0, -6.0),
        "purple": (6.0, -30.0, 14.0),
    }
    return body("four-ball body", places, 15.0)


def three_camera_rig() -> tuple[Camera, ...]:
    """Three cameras, 120 degrees apart, a little higher and nearer."""
    return ring(3, seed=3, distance_mm=430.0, elevation_deg=32.0)


def cluttered_scene(seed: int = 1) -> Scene:
    """The plain scene in a coloured room."""
    return replace(
        plain_scene("grey", seed),
        name="plain-clutter",
        backdrop=coloured_room(seed),
        backdrop_px=2,
        description="clutter background; blur, sRGB and noise only",
    )


def occluded_scene(seed: int = 2) -> Scene:
    """The shaft goes up through the view, and a dark pole stands in front."""
    body = paper_body()
    pole = Capsule(
        np.array([70.0, -95.0, 0.0]), np.array([78.0, -88.0, 600.0]), 8.0, Material((0.02,) * 3)
    )
    return replace(
        webcam_scene(seed),
        name="occluded",
        attached=(*stems(body), shaft(up=True)),
        fixed=(pole,),
        description="shaft upwards through the view, a dark pole in front",
    )


def clutter_scene(seed: int = 3) -> Scene:
    """Dim and noisy, a coloured room, and balls of our colours that are not ours."""
    scene = webcam_scene(seed)
    lit = lamps(seed, 2, 0.25, (1.0, 0.93, 0.85))
    light = Lighting(lit, (0.10, 0.09, 0.08), (0.2, 0.2, 0.2), 0.5, shadows=True)
    return replace(
        scene,
        name="clutter",
        lighting=light,
        fixed=clutter(seed, scene.body.names),
        backdrop=coloured_room(seed),
        backdrop_px=2,
        sensor=replace(WEBCAM, electrons=2500.0, read_noise=10.0, gain=1.6),
        description="dim light, coloured room, distractor balls in the same colours",
    )


def async_scene(seed: int = 4) -> Scene:
    """Free-running cameras, exposures of 15 to 24 ms, up to 60 mm/s."""
    scene = webcam_scene(seed)
    rng = np.random.default_rng(seed)
    names = [camera.name for camera in scene.cameras]
    limits = MotionLimits(speed_mm_s=60.0, turn_rad_s=1.0, slowest_hz=0.3, fastest_hz=0.9)
    return replace(
        scene,
        name="async",
        trajectory=motion(seed, limits),
        sensors={n: replace(WEBCAM, exposure_s=rng.uniform(0.015, 0.024)) for n in names},
        phases_s={n: rng.uniform(0.0, 1 / 30) for n in names},
        description="each camera with its own phase; motion blur of 15-24 ms",
    )


def rolling(scene: Scene, row_time_s: float) -> Scene:
    """The scene through shutters that take so long from row to row, as the calibration says."""
    cameras = [
        replace(camera, readout_s=row_time_s * camera.intrinsics.size_wh[1])
        for camera in scene.cameras
    ]
    return replace(
        scene, cameras=tuple(cameras), sensor=replace(scene.sensor, row_time_s=row_time_s)
    )


def scene_catalogue() -> dict[str, Scene]:
    """All scenes by name, built anew.

    No two rest on the same kind of picture: finish, room, sensor, body and rig all vary.
    """
    still = webcam_scene()
    other = four_ball_body()
    bent = replace(WEBCAM, tone="bent", sharpen=0.7, sharpen_px=1.1)
    scenes = (
        plain_scene("black"),
        plain_scene("grey"),
        cluttered_scene(),
        still,
        occluded_scene(),
        clutter_scene(),
        async_scene(),
        replace(still, name="matt", finish=MATT, description="matt paint"),
        replace(still, name="sharpened", sensor=bent, description="sharpening, bent tone curve"),
        replace(
            still,
            name="jpeg422",
            sensor=replace(WEBCAM, quality=85, chroma="422"),
            description="JPEG 4:2:2, quality 85",
        ),
        replace(
            still,
            name="four-balls",
            body=other,
            attached=(*stems(other), shaft()),
            backdrop=cloth_room(0.05, 7),
            description="four balls of radius 15 mm in other colours, white among them",
        ),
        replace(
            still, name="three-cameras", cameras=three_camera_rig(), description="three cameras"
        ),
        replace(
            rolling(still, 30e-6),
            name="rolling",
            trajectory=motion(9, MotionLimits(slowest_hz=0.3, fastest_hz=0.9)),
            description="rolling shutter, 30 us a row",
        ),
    )
    return {scene.name: mirrored(scene) for scene in scenes}


def relit_scenes() -> dict[str, Scene]:
    """The catalogue's kinds of scene under other lamps, in other rooms, moving otherwise, by name.

    The frames of one scene share their systematic error; many scenes show its distribution.
    """
    scenes = [
        replace(scene, name=f"{scene.name} {seed}")
        for seed in _OTHER_SEEDS
        for scene in (
            plain_scene("black", seed),
            plain_scene("grey", seed),
            cluttered_scene(seed),
            webcam_scene(seed),
            occluded_scene(seed),
            clutter_scene(seed),
            async_scene(seed),
        )
    ]
    return {scene.name: mirrored(scene) for scene in scenes}


def clutter(seed: int, colors: tuple[str, ...], radius_mm: float = 20.0) -> tuple[Shape, ...]:
    """Boxes, columns, and balls on sticks in the given colours, round about the workspace."""
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = []
    names = list(BALL_ALBEDO)
    for k in range(10):
        x, y = _beside(rng, k / 10, (560.0, 850.0))
        color = Material(BALL_ALBEDO[names[int(rng.integers(len(names)))]])
        high = rng.uniform(80, 260)
        turn = RigidTransform.from_rotvec([0.0, 0.0, rng.uniform(0, np.pi)], [x, y, high / 2])
        if k % 3 == 2:
            shapes.append(Capsule(np.array([x, y, 0.0]), np.array([x, y, high]), 45.0, color))
        else:
            shapes.append(Cuboid(turn, (rng.uniform(80, 150), rng.uniform(80, 150), high), color))
    for k, name in enumerate((*colors, *colors)):
        x, y = _beside(rng, (k + 0.5) / (2 * len(colors)), (260.0, 420.0))
        top = np.array([x, y, rng.uniform(150, 300)])
        stick = Material((0.02, 0.02, 0.02), 0.04, 0.1)
        shapes.append(Capsule(np.array([x, y, 0.0]), top, 7.0, stick))
        gloss = painted(Material((1.0, 1.0, 1.0), 0.04, 0.06), name)
        shapes.append(Sphere(top, radius_mm * rng.uniform(0.8, 1.15), gloss))
    return tuple(shapes)


def _beside(rng: np.random.Generator, turn: float, range_mm: tuple[float, float]) -> Floats:
    """A place (2,) on the floor, at a share of a full turn, a random distance off."""
    angle = 2 * np.pi * (turn + rng.uniform(-0.03, 0.03))
    return rng.uniform(*range_mm) * np.array([np.cos(angle), np.sin(angle)])
