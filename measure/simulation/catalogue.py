"""The scenes that tests, benchmarks and the demo measure; each in one function call."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.geometry import RigidTransform
from measure.simulation.presets import (
    MATT,
    PLASTIC,
    WORKSPACE_MM,
    four_ball_body,
    lamps,
    paper_body,
    paper_rig,
    plain_lighting,
    shaft,
    stems,
    three_camera_rig,
)
from measure.simulation.rooms import cloth_room, clutter, coloured_room
from measure.simulation.scene import Scene
from measure.simulation.sensor import Sensor
from measure.simulation.shading import Lighting, Material
from measure.simulation.shapes import Capsule
from measure.simulation.trajectory import MotionLimits, Sines, random_motion

WEBCAM = Sensor(
    blur_px=0.6, bayer=True, electrons=9000.0, read_noise=11.0, quality=90, chroma="420"
)
"""Mosaic, noise and JPEG like a webcam's; the tone curve is sRGB."""
PLAIN_CAMERA = Sensor(blur_px=0.7, level_noise=2.0, encoding="png")
"""Blur, sRGB and noise of two levels, nothing else: the response is known."""

_OTHER_SEEDS = (11, 12, 13, 14)
"""Of lamps, rooms, motions and noise that no scene of the catalogue has."""


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
    """The simplest chain of known response, before a black, grey or cluttered background.

    These are the scenes of the accuracy limits: grey stems, two lamps, no mosaic, no JPEG.
    """
    body = paper_body()
    level = {"black": 0.01, "grey": 0.12, "clutter": 0.15}[background]
    backdrop = coloured_room(seed) if background == "clutter" else cloth_room(level, seed)
    return Scene(
        f"plain-{background}",
        body,
        paper_rig(),
        motion(seed + 100),
        plain_lighting(seed),
        finish=Material((1.0, 1.0, 1.0), 0.03, 0.08),
        attached=stems(body, (0.18, 0.18, 0.18)),
        backdrop=backdrop,
        backdrop_px=2 if background == "clutter" else 4,
        sensor=PLAIN_CAMERA,
        seed=seed,
        description=f"{background} background; blur, sRGB and noise only",
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
        plain_scene("clutter"),
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
    return {scene.name: scene for scene in scenes}


def relit_scenes() -> dict[str, Scene]:
    """The catalogue's kinds of scene under other lamps, in other rooms, moving otherwise, by name.

    One scene says how well one light is told: its frames err alike. Many say how well any is.
    """
    scenes = [
        replace(scene, name=f"{scene.name} {seed}")
        for seed in _OTHER_SEEDS
        for scene in (
            plain_scene("black", seed),
            plain_scene("grey", seed),
            plain_scene("clutter", seed),
            webcam_scene(seed),
            occluded_scene(seed),
            clutter_scene(seed),
            async_scene(seed),
        )
    ]
    return {scene.name: scene for scene in scenes}
