"""Mirrored light against closed forms: what a glossy thing shows must be what is there."""

from __future__ import annotations

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.simulation import Capsule, Cuboid, Material, Sphere
from tests.simulation.mirror_rooms import (
    CENTER,
    RADIUS,
    SMOOTH,
    beside,
    chequered,
    closed_room,
    mirrored_rays,
    scene,
    seen,
    wall_colours,
)
from tests.simulation.test_renderer import small_camera


@pytest.mark.parametrize(("roughness", "reflectance"), [(0.0, 1.0), (0.02, 0.3), (0.3, 0.04)])
def test_nothing_is_seen_in_a_room_of_even_light(roughness, reflectance) -> None:
    """The furnace: white things that lose no light vanish, also beside each other."""
    white = Material((1.0, 1.0, 1.0), reflectance, roughness)
    things = (
        Sphere(CENTER, RADIUS, white),
        Sphere(beside(30, 25, 10), 15.0, white),
        Capsule(beside(-50, 0, -40), beside(-20, -10, 30), 6.0, white),
        Cuboid(RigidTransform(np.eye(3), beside(0, 0, -45)), (60.0, 40.0, 8.0), white),
    )
    picture = seen(scene(*things, walls=closed_room((1.0, 1.0, 1.0))))
    assert np.abs(picture - 1.0).max() < 1e-6


def test_a_smooth_ball_shows_what_its_mirrored_rays_meet() -> None:
    walled = scene(Sphere(CENTER, RADIUS, SMOOTH), walls=closed_room(texture=chequered))
    pixels, places, _, on = mirrored_rays(walled.cameras[0])
    expected, edge = wall_colours(places, on)
    clear = edge > 0.1
    assert clear.sum() > 2000
    found = seen(walled)[pixels[:, 1], pixels[:, 0]]
    assert np.abs(found - expected)[clear].max() < 1e-6
    assert len(np.unique(expected[clear], axis=0)) == 2


def test_the_outline_mirrors_what_lies_just_outside() -> None:
    """Grazing rays go straight on: a smooth plastic ball fades into the wall behind it."""
    plastic = Material((0.0, 0.0, 0.0), 0.04, 0.0)
    wall = (0.2, 0.4, 0.7)
    picture = seen(scene(Sphere(CENTER, RADIUS, plastic), walls=closed_room(wall)))
    pixels, places, normals, _ = mirrored_rays(small_camera())
    view = (small_camera().center - places) / np.linalg.norm(
        small_camera().center - places, axis=1, keepdims=True
    )
    fresnel = 0.04 + 0.96 * (1 - np.sum(view * normals, axis=1)) ** 5
    found = picture[pixels[:, 1], pixels[:, 0]]
    assert np.abs(found - fresnel[:, None] * wall).max() < 1e-6
    assert fresnel.max() > 0.25
