"""The scenes of the demonstration and of the conformance kit."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import paper_body
from measure.simulation import presets
from measure.simulation.scene import Scene
from measure.simulation.sensor import CameraSensor
from measure.simulation.shading import Lighting, Material
from measure.simulation.shapes import Cuboid, Shape
from measure.simulation.trajectory import MotionLimits, Sines, random_motion

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
    return random_motion(seed, RigidTransform(np.eye(3), presets.WORKSPACE_MM), limits)


def webcam_scene(seed: int = 1) -> Scene:
    """Glossy balls before black cloth, synchronised webcams, no motion blur."""
    body = paper_body()
    return Scene(
        "still",
        body,
        presets.paper_rig(),
        motion(seed),
        Lighting(presets.lamps(seed), (0.15, 0.15, 0.15), (0.12, 0.12, 0.12), shadows=True),
        finish=presets.PLASTIC,
        attached=(*presets.stems(body), presets.shaft(color=(0.02, 0.02, 0.02))),
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
        presets.paper_rig(),
        motion(seed + 100),
        presets.plain_lighting(seed),
        finish=Material((1.0, 1.0, 1.0), 0.03, 0.08),
        attached=presets.stems(body, (0.18, 0.18, 0.18)),
        backdrop=cloth_room({"black": 0.01, "grey": 0.12}[background], seed),
        sensor=PLAIN_CAMERA,
        seed=seed,
        description=f"{background} background; blur, sRGB and noise only",
    )
