"""How far centres come out too far from the optical axis, by the angle from it.

A ball's outline is an ellipse whose centre is not the image of the ball's: off the axis, methods
that take the one for the other err outwards. The scene is the plain black one with each camera
turned aside by another angle.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.methods import METHODS
from benchmarks.trial import center_errors
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Camera
from measure.session import open_session, read_trajectory
from measure.simulation import write_session
from measure.simulation.catalogue import plain_scene

BINS_DEG = (0.0, 4.0, 8.0, 12.0)
_ASIDE_DEG = (2.0, 5.0, 7.5, 9.0)


def off_axis_recording(folder: Path, frames: int) -> Path:
    """Render the scene, once, into `folder`."""
    target = folder / f"off-axis-{frames}"
    if not (target / "truth.csv").exists():
        scene = plain_scene("black")
        cameras = tuple(_turned(c, a) for c, a in zip(scene.cameras, _ASIDE_DEG, strict=True))
        write_session(
            replace(scene, name="off-axis", cameras=cameras), np.arange(frames) / 30, target
        )
    return target


def off_axis_rows(path: Path, methods: str) -> list[tuple[str, ...]]:
    """Method, and the median outward error in px in each of the bins."""
    truth, registry, rows = read_trajectory(path / "truth.csv"), Registry.discover(), []
    for method in METHODS:
        if methods in method.name:
            with open_session(path) as session:
                pipeline = method.pipeline(session, registry)
                measured = list(pipeline.measure(session.frame_sets()))
                errors = list(center_errors(session, truth, measured))
            angles = np.array([error.off_axis_deg for error in errors])
            outward = np.array([error.outward_px for error in errors])
            bins = np.digitize(angles, BINS_DEG) - 1
            rows.append(
                (method.name, *(_cell(outward[bins == k]) for k in range(len(BINS_DEG) - 1)))
            )
    return rows


def _cell(outward: np.ndarray) -> str:
    return f"{np.median(outward):+.3f}" if len(outward) else "none"


def _turned(camera: Camera, aside_deg: float) -> Camera:
    """The camera turned about its own vertical axis."""
    turn = RigidTransform.from_rotvec(np.array([0.0, np.radians(aside_deg), 0.0]), np.zeros(3))
    return replace(camera, world_from_camera=camera.world_from_camera @ turn)
