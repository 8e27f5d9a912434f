"""Scenes that ask more of a measurement than those of the catalogue: unusual pictures, combined.

Light, finish, lens, distance, body and camera as users meet them, two or three out of the ordinary
at once. They are rendered to find out where results get weak, and whether they say so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.model import Camera, Intrinsics
from measure.simulation.catalogue import (
    WEBCAM,
    WORKSPACE_MM,
    cloth_room,
    lamps,
    motion,
    ring,
    shaft,
    stems,
    webcam_scene,
)
from measure.simulation.scene import Lamp, Lighting, MotionLimits, Rgb, Scene, Sphere, painted
from tests.simulated.catalogue import MATT, body, clutter_scene, four_ball_body, rolling
from tests.simulated.mirroring import mirrored

_BENT = replace(WEBCAM, tone="bent", sharpen=0.7, sharpen_px=1.1)


def desk_lamp() -> Scene:
    """One hard lamp beside the body, and next to no other light."""
    lamp = Lamp(WORKSPACE_MM + np.array([800.0, 150.0, 100.0]), (1.2, 1.15, 1.1), 40.0)
    return replace(
        webcam_scene(19),
        name="desk-lamp",
        lighting=_lit((lamp,), 0.03, 0.05),
        description="one hard lamp from the side, next to no other light",
    )


def overexposed() -> Scene:
    """So much light that bright colours are clipped."""
    return replace(
        _four_balls(webcam_scene(33)),
        name="overexposed",
        sensor=replace(WEBCAM, gain=2.2),
        description="four balls, clipped colours",
    )


def dim() -> Scene:
    """An eighth of the usual light: short of photons, much gain."""
    return replace(
        webcam_scene(18),
        name="dim",
        lighting=_lit(lamps(18, 2, 0.06), 0.02, 0.03),
        sensor=replace(WEBCAM, electrons=1500.0, read_noise=8.0, gain=3.0),
        description="dim and noisy",
    )


def soft_light() -> Scene:
    """Matt balls under an overcast sky: no lamp, no shadow, no highlight."""
    return replace(
        webcam_scene(41),
        name="soft-light",
        finish=MATT,
        lighting=_lit((), 0.7, 0.5),
        description="matt balls, light from all sides, no lamp",
    )


def white_room() -> Scene:
    """A white ball and three others before white walls."""
    return replace(
        _four_balls(webcam_scene(14), 0.55, 9),
        name="white-room",
        lighting=_lit(lamps(14, 2, 0.45), 0.25, 0.35),
        description="four balls, white among them, before white walls",
    )


def far() -> Scene:
    """Small balls, far away: outlines of 12 px."""
    places = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-38.0, 0.0, 0.0)}
    small = body("small three-ball body", places, 10.0)
    return replace(
        webcam_scene(29),
        name="far",
        body=small,
        attached=(*stems(small), shaft(color=(0.02, 0.02, 0.02))),
        cameras=ring(4, 29, 1150.0),
        description="balls of radius 10 mm at 1150 mm, outlines of 12 px",
    )


def small_pictures() -> Scene:
    """Cameras of 640x480."""
    return replace(
        webcam_scene(24),
        name="small-pictures",
        cameras=tuple(_resized(camera, 0.5, (640, 480)) for camera in ring(4, 24)),
        description="pictures of 640x480",
    )


def wide_lens() -> Scene:
    """Near cameras with short, strongly distorting lenses."""
    distortion = np.array([-0.32, 0.12, 0.001, -0.0008, -0.02])
    cameras = tuple(_with_lens(camera, 820.0, distortion) for camera in ring(4, 25, 300.0))
    return replace(
        webcam_scene(25),
        name="wide-lens",
        cameras=cameras,
        description="short lenses with strong distortion",
    )


def two_cameras() -> Scene:
    """Two cameras, at right angles."""
    return replace(
        webcam_scene(17), name="two-cameras", cameras=ring(4, 17)[:2], description="two cameras"
    )


def quick_compressed() -> Scene:
    """Motion blur, unsynchronised, in coarse JPEG 4:2:2."""
    scene, rng = webcam_scene(16), np.random.default_rng(16)
    coarse = replace(WEBCAM, quality=70, chroma="422")
    names = [camera.name for camera in scene.cameras]
    return replace(
        scene,
        name="quick-compressed",
        trajectory=motion(16, MotionLimits(speed_mm_s=60, slowest_hz=0.3, fastest_hz=0.9)),
        sensors={n: replace(coarse, exposure_s=rng.uniform(0.015, 0.024)) for n in names},
        phases_s={n: rng.uniform(0, 1 / 30) for n in names},
        description="up to 60 mm/s, not synchronised, JPEG 4:2:2 of quality 70",
    )


def out_of_round(seed: int = 27) -> Scene:
    """Balls 0.1, 0.2 and 0.3 mm longer in one direction each, as two spheres all but coincide."""
    scene, rng = webcam_scene(seed), np.random.default_rng(seed)
    halves: list[Sphere] = []
    balls = []
    for ball, longer_mm in zip(scene.body.balls, (0.1, 0.2, 0.3), strict=True):
        axis = rng.normal(size=3)
        aside = longer_mm / 2 * axis / np.linalg.norm(axis)
        balls.append(replace(ball, center_mm=ball.center_mm + aside))
        paint = painted(scene.finish, ball.color.name)
        halves.append(Sphere(ball.center_mm - aside, ball.radius_mm, paint))
    return replace(
        scene,
        name="out-of-round",
        body=replace(scene.body, balls=tuple(balls)),
        stated_body=scene.body,
        attached=(*halves, *scene.attached),
        description="balls 0.1, 0.2 and 0.3 mm out of round",
    )


def rolling_blurred() -> Scene:
    """Motion blur and rolling shutter, as a webcam indoors has both."""
    limits = MotionLimits(speed_mm_s=60, slowest_hz=0.3, fastest_hz=0.9)
    scene = rolling(replace(webcam_scene(28), trajectory=motion(28, limits)), 30e-6)
    return replace(
        scene,
        name="rolling-blurred",
        sensor=replace(scene.sensor, exposure_s=0.02),
        description="up to 60 mm/s, exposures of 20 ms, rolling shutter of 30 us a row",
    )


def clutter_sharpened() -> Scene:
    """A coloured room and false balls, seen by a camera that sharpens and bends the tone curve."""
    return replace(
        clutter_scene(30),
        name="clutter-sharpened",
        sensor=replace(_BENT, electrons=4000.0),
        description="coloured room, distractor balls, sharpening, bent tone curve",
    )


def four_matt_bent() -> Scene:
    """Another body, matt, three cameras that sharpen and bend the tone curve."""
    return replace(
        _four_balls(webcam_scene(43), 0.1, 3),
        name="four-matt-bent",
        finish=MATT,
        cameras=ring(3, 44, 430.0, 32.0),
        sensor=replace(WEBCAM, tone="bent", sharpen=0.4),
        description="four matt balls, three cameras, mild sharpening, bent tone curve",
    )


def four_matt_compressed() -> Scene:
    """The same with all else out of the ordinary too: stronger sharpening, JPEG 4:2:2."""
    return replace(
        _four_balls(webcam_scene(13), 0.06, 9),
        name="four-matt-compressed",
        finish=MATT,
        cameras=ring(3, 14, 430.0, 32.0),
        sensor=replace(_BENT, quality=85, chroma="422"),
        description="four matt balls, three cameras, sharpening, bent tone curve, JPEG 4:2:2",
    )


def unusual_scenes() -> dict[str, Scene]:
    """All of them by name, built anew."""
    scenes = (
        desk_lamp(),
        overexposed(),
        dim(),
        soft_light(),
        white_room(),
        far(),
        small_pictures(),
        wide_lens(),
        two_cameras(),
        quick_compressed(),
        rolling_blurred(),
        out_of_round(),
        clutter_sharpened(),
        four_matt_bent(),
        four_matt_compressed(),
    )
    return {scene.name: mirrored(scene) for scene in scenes}


def _lit(lights: tuple[Lamp, ...], ambient: float, surround: float) -> Lighting:
    """Lamps, and white light from all round."""
    return Lighting(lights, _grey(ambient), _grey(surround), shadows=True)


def _grey(level: float) -> Rgb:
    return (level, level, level)


def _four_balls(scene: Scene, level: float = 0.05, seed: int = 7) -> Scene:
    """The scene with the four-ball body, before cloth of the given reflectance."""
    other = four_ball_body()
    return replace(
        scene, body=other, attached=(*stems(other), shaft()), backdrop=cloth_room(level, seed)
    )


def _resized(camera: Camera, share: float, size_wh: tuple[int, int]) -> Camera:
    """The camera with another sensor: as many px per rad times `share`, and another size."""
    inner = camera.intrinsics
    matrix = inner.matrix.copy()
    matrix[:2] *= share
    middle = (np.array(inner.size_wh) - 1) / 2
    matrix[:2, 2] = (np.array(size_wh) - 1) / 2 + share * (inner.matrix[:2, 2] - middle)
    return replace(camera, intrinsics=Intrinsics(size_wh, matrix, inner.distortion))


def _with_lens(camera: Camera, focal_px: float, distortion: Floats) -> Camera:
    """The camera with another lens."""
    inner = camera.intrinsics
    matrix = inner.matrix.copy()
    matrix[0, 0] = matrix[1, 1] = focal_px
    return replace(camera, intrinsics=Intrinsics(inner.size_wh, matrix, distortion))
