"""Scenes that must not be measured with confidence: negative controls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.geometry import RigidTransform
from measure.model import Camera
from measure.simulation.scene import Actor, ContinuousTrajectory, Scene, ball_shapes


def without_balls(scene: Scene) -> Scene:
    """Nothing of the body is in view."""
    return replace(scene, name=f"{scene.name}-no-ball", shown=(), attached=())


def with_balls(scene: Scene, *names: str) -> Scene:
    """Only the named balls are in view."""
    return replace(scene, name=f"{scene.name}-only-{'-'.join(names)}", shown=names)


def with_second_body(scene: Scene, trajectory: ContinuousTrajectory) -> Scene:
    """An identical body moves along another trajectory."""
    twin = Actor((*ball_shapes(scene.body, scene.finish), *scene.attached), trajectory)
    return replace(scene, name=f"{scene.name}-twin", actors=(*scene.actors, twin))


def upside_down(scene: Scene, camera: str) -> Scene:
    """One camera has been turned by 180 degrees about its axis since it was calibrated."""
    return _displaced(scene, camera, np.array([0, 0, 0, 0, 0, np.pi]), "upside-down")


def swapped_calibrations(scene: Scene, first: str, second: str) -> Scene:
    """The calibration file gives each of two cameras the other's values."""
    a, b = scene.camera(first), scene.camera(second)
    swap = {first: replace(b, name=first), second: replace(a, name=second)}
    stated = tuple(swap.get(camera.name, camera) for camera in scene.cameras)
    return replace(scene, name=f"{scene.name}-swapped", stated_cameras=stated)


def misstated_body(scene: Scene, centers_mm: dict[str, tuple[float, float, float]]) -> Scene:
    """The body file claims other places for some balls (wrong size, swapped or mirrored)."""
    places = np.array([centers_mm.get(ball.name, ball.center_mm) for ball in scene.body.balls])
    stated = scene.body.with_centers(places)
    return replace(scene, name=f"{scene.name}-wrong-body", stated_body=stated)


def _displaced(scene: Scene, name: str, delta_camera: np.ndarray, what: str) -> Scene:
    """One camera displaced in its own frame; the calibration file does not know."""
    step = RigidTransform.identity().perturb(delta_camera)

    def move(camera: Camera) -> Camera:
        if camera.name != name:
            return camera
        return replace(camera, world_from_camera=camera.world_from_camera @ step)

    scene.camera(name)
    return replace(
        scene,
        name=f"{scene.name}-{what}",
        cameras=tuple(move(camera) for camera in scene.cameras),
        stated_cameras=scene.stated_cameras or scene.cameras,
    )
