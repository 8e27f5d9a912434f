"""Unusual scenes are what they say they are, and can be measured by what they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.simulation import Renderer, Scene
from measure.simulation.canvas import reduced
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.unusual import unusual_scenes

SCENES = unusual_scenes()
WHOLE = {"small-pictures", "overexposed"}
"""Scenes whose point a quarter of the resolution would lose."""


def picture(scene: Scene, of: str = "cam0") -> np.ndarray:
    """What a camera sees at half a second, of a quarter of the size."""
    if scene.name not in WHOLE:
        cameras = tuple(replace(c, intrinsics=reduced(c.intrinsics, 4)) for c in scene.cameras)
        scene = replace(scene, cameras=cameras)
    return Renderer(scene, of).picture(0.5)


def outline_px(scene: Scene) -> float:
    """The mean radius of a ball's outline."""
    return float(
        np.mean(
            [
                c.intrinsics.focal_px * b.radius_mm / np.linalg.norm(c.center - [0, 0, 250])
                for c in scene.cameras
                for b in scene.body.balls
            ]
        )
    )


def test_none_is_called_like_a_usual_one() -> None:
    assert 8 <= len(SCENES) <= 16
    assert not set(SCENES) & set(scene_catalogue())
    assert all(name == scene.name and scene.description for name, scene in SCENES.items())
    assert len({scene.seed for scene in SCENES.values()}) == len(SCENES)


@pytest.mark.parametrize("name", SCENES)
def test_every_ball_is_in_sight_of_two_cameras(name) -> None:
    scene = SCENES[name]
    centers = scene.trajectory.at(np.array([0.0, 0.25]))
    for time in centers:
        for ball in scene.body.balls:
            at = time.apply(ball.center_mm)[None]
            assert sum(bool(c.intrinsics.contains(c.project(at))[0]) for c in scene.cameras) >= 2


def test_light_is_as_said() -> None:
    usual = picture(scene_catalogue()["still"])
    assert np.median(picture(SCENES["white-room"])) > 3 * np.median(usual)
    clipped = picture(SCENES["overexposed"])
    assert np.count_nonzero(clipped.max(axis=2) == 255) > 2000
    assert np.count_nonzero(usual.max(axis=2) == 255) < 20


def test_desk_lamp_lights_half_of_a_ball() -> None:
    scene = SCENES["desk-lamp"]
    camera = scene.cameras[0]
    shown = Renderer(scene, camera.name).picture(0.5).max(axis=2).astype(float)
    at = scene.trajectory.at(np.array([0.5]))[0].apply(scene.body.balls[0].center_mm)
    u, v = camera.project(at[None])[0]
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    r = 0.85 * outline_px(scene)
    rim = shown[
        np.rint(v + r * np.sin(angle)).astype(int), np.rint(u + r * np.cos(angle)).astype(int)
    ]
    # The dark side mirrors the next ball, which is lit: only what lies beside that is dark.
    assert np.quantile(rim, 0.9) > 4 * np.quantile(rim, 0.15)


def test_geometry_is_as_said() -> None:
    assert outline_px(SCENES["far"]) == pytest.approx(12.3, abs=0.5)
    assert len(SCENES["two-cameras"].cameras) == 2
    small = picture(SCENES["small-pictures"], "cam1")
    assert small.shape == (480, 640, 3)
    camera, other = SCENES["wide-lens"].cameras[0], scene_catalogue()["still"].cameras[0]
    inner = camera.intrinsics
    corner = inner.unproject(np.array([[60.0, 60.0]]))[0]
    assert np.degrees(np.arccos(corner @ [0, 0, 1])) > 40
    assert inner.focal_px < 0.6 * other.intrinsics.focal_px


def test_resized_camera_sees_what_the_whole_one_sees() -> None:
    from measure.simulation.catalogue import ring

    point = np.array([[20.0, -30.0, 260.0]])
    for whole, half in zip(ring(4, 24), SCENES["small-pictures"].cameras, strict=True):
        middle, small = np.array([639.5, 359.5]), np.array([319.5, 239.5])
        assert half.project(point) - small == pytest.approx((whole.project(point) - middle) / 2)
