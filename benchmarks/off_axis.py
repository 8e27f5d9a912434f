"""Bias of detected centres away from the optical axis, by the angle from it.

A ball's outline is an ellipse whose centre is not the image of the ball's: off the axis, methods
that take the one for the other err outwards. The scene is the plain black one, recorded often: each
camera is turned aside by every angle, upwards, downwards, left and right, so that what light does
to the outlines, which is the same whichever way a camera is turned, cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.methods import METHODS, Method
from benchmarks.trial import CenterError, center_errors
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Camera
from measure.session import open_session, read_trajectory
from measure.simulation import write_session
from measure.simulation.catalogue import plain_scene

BINS_DEG = (0.0, 4.0, 8.0, 12.0)
_TURN_DEG = (2.0, 5.0, 7.0, 8.5)
_TOWARDS_DEG = (0.0, 90.0, 180.0, 270.0)


def off_axis_recordings(folder: Path, frames: int) -> list[Path]:
    """Render the scene, once, into `folder`, as often as there are angles times directions."""
    scene, targets = plain_scene("black"), []
    for first, towards in product(range(len(_TURN_DEG)), _TOWARDS_DEG):
        targets.append(folder / f"off-axis-{frames}-{first}-{towards:.0f}")
        if not (targets[-1] / "truth.csv").exists():
            cameras = tuple(
                turned(camera, _TURN_DEG[(k + first) % len(_TURN_DEG)], towards)
                for k, camera in enumerate(scene.cameras)
            )
            turned = replace(scene, name="off-axis", cameras=cameras)
            write_session(turned, np.arange(frames) / 30, targets[-1])
    return targets


def off_axis_rows(paths: Sequence[Path], methods: str) -> list[tuple[str, ...]]:
    """Method, and the median outward error in px in each of the bins."""
    registry, rows = Registry.discover(), []
    for method in METHODS:
        if methods in method.name:
            errors = [error for path in paths for error in _errors(path, method, registry)]
            angles = np.array([error.off_axis_deg for error in errors])
            outward = np.array([error.outward_px for error in errors])
            bins = np.digitize(angles, BINS_DEG) - 1
            rows.append(
                (method.name, *(_cell(outward[bins == k]) for k in range(len(BINS_DEG) - 1)))
            )
    return rows


def _errors(path: Path, method: Method, registry: Registry) -> list[CenterError]:
    with open_session(path) as session:
        pipeline = method.pipeline(session, registry)
        measured = list(pipeline.measure(session.frame_sets()))
        return list(center_errors(session, read_trajectory(path / "truth.csv"), measured))


def _cell(outward: np.ndarray) -> str:
    return f"{np.median(outward):+.3f}" if len(outward) else "none"


def turned(camera: Camera, aside_deg: float, towards_deg: float) -> Camera:
    """The camera turned so that what was ahead is seen towards a direction of its picture."""
    towards = np.radians(towards_deg)
    axis = np.array([np.sin(towards), -np.cos(towards), 0.0])
    turn = RigidTransform.from_rotvec(np.radians(aside_deg) * axis, np.zeros(3))
    return replace(camera, world_from_camera=camera.world_from_camera @ turn)
