"""The scenes of the demonstration and of the conformance kit."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.model import paper_body
from measure.simulation.presets import (
    PLASTIC,
    WORKSPACE_MM,
    lamps,
    paper_rig,
    plain_lighting,
    shaft,
    stems,
)
from measure.simulation.rooms import cloth_room
from measure.simulation.scene import Scene
from measure.simulation.sensor import CameraSensor
from measure.simulation.shading import Lighting, Material
from measure.simulation.trajectory import MotionLimits, Sines, random_motion

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
