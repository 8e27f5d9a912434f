"""Mirrored light against closed forms: what a glossy thing shows must be what is there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.simulation import (
    Actor,
    CameraSensor,
    Capsule,
    Cuboid,
    Lamp,
    Lighting,
    Material,
    Sphere,
    Still,
)
from measure.simulation.caster import Stage
from measure.simulation.catalogue import PLASTIC, look_at
from tests.simulation.mirror_rooms import (
    CENTER,
    EVEN,
    RADIUS,
    SMOOTH,
    beside,
    chequered,
    closed_room,
    mirrored_rays,
    nearest_ball,
    scene,
    seen,
    wall_colours,
)
from tests.simulation.test_renderer import small_camera


@pytest.mark.parametrize("roughness", [0.0, 0.02, 0.08, 0.3])
@pytest.mark.parametrize("reflectance", [0.04, 0.3, 1.0])
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


def test_things_that_lose_light_are_seen_there() -> None:
    ball = Sphere(CENTER, RADIUS, Material((0.0, 0.0, 0.0), 0.9, 0.08))
    picture = seen(scene(ball, walls=closed_room((1.0, 1.0, 1.0))))
    assert picture.min() == pytest.approx(0.9, abs=0.002)
    assert picture.max() == pytest.approx(1.0, abs=1e-6)


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


def test_a_rolling_shutter_applies_to_mirror_images() -> None:
    velocity, row_time = np.array([30.0, -20.0, 15.0]), 4e-4

    class Straight:
        def at(self, times_s):
            times = np.asarray(times_s, dtype=float)[..., None]
            return RigidTransform(
                np.broadcast_to(np.eye(3), (*times.shape[:-1], 3, 3)), times * velocity
            )

    moving = Actor((Sphere(CENTER, RADIUS, SMOOTH),), Straight())
    walls = closed_room(texture=chequered)
    sensor = CameraSensor(blur_px=0.0, row_time_s=row_time)
    found = seen(scene(walls=walls, actors=(moving,), sensor=sensor))
    checked, at_rest = 0, []
    for row in (105, 120, 135):
        for delay in ((row - 119.5) * row_time, 0.0):
            center = CENTER + delay * velocity
            pixels, places, _, on = mirrored_rays(small_camera(), center, 6.0)
            here = pixels[:, 1] == row
            expected, edge = wall_colours(places[here], on[here])
            error = np.abs(found[row, pixels[here, 0]] - expected).max(axis=1)[edge > 0.1]
            if delay:
                assert error.max() < 1e-6
                checked += len(error)
            else:
                at_rest.append(error.max())
    assert checked > 100
    assert max(at_rest) > 0.1, "a ball that stands would mirror other places"


def test_mirrored_shapes_are_lit_as_seen_directly() -> None:
    """What is matt looks alike from everywhere: in the mirror as from a camera of its own."""
    target, source = beside(90.0, -90.0, -20.0), beside(130.0, 200.0, 600.0)
    lamp, up = (
        Lamp(source, (2.0, 1.5, 1.0), 20.0),
        (source - target) / np.linalg.norm(source - target),
    )
    # Between the lamp and the side that the mirror shows.
    blocker = target + 75.0 * up + 0.25 * (CENTER - target)
    light = Lighting((lamp,), (0.2, 0.2, 0.2), (0.0, 0.0, 0.0), shadows=True)
    matt = Sphere(target, 40.0, Material((0.7, 0.5, 0.3)))
    mirror = Sphere(CENTER, RADIUS, SMOOTH)
    shade = Sphere(blocker, 14.0, Material((0.3, 0.3, 0.3)))
    first = small_camera()
    other = replace(first, name="other", world_from_camera=look_at(beside(-60, 40, 120), target))
    lit = scene(mirror, matt, shade, light=light, cameras=(first, other))

    pixels, places, _, on = mirrored_rays(first)
    away = nearest_ball(places, on, target, 40.0)
    first_met = away < nearest_ball(places, on, blocker, 14.0)
    hits = places[first_met] + away[first_met, None] * on[first_met]
    uv = np.rint(other.project(hits)).astype(int)
    direct = seen(lit, "other")
    wide = np.array(direct.shape[1::-1]) - 1
    fits = np.all((uv >= 1) & (uv < wide), axis=1)
    fits &= _faces(other, hits, target, 40.0)
    for center, radius in ((CENTER, RADIUS), (blocker, 14.0)):
        fits &= _clear(other, hits, center, radius + 3)
    p = pixels[first_met][fits]
    expected = direct[uv[fits, 1], uv[fits, 0]]
    mirrored = seen(lit)[p[:, 1], p[:, 0]]
    assert len(p) > 80
    assert np.median(np.abs(mirrored - expected).max(axis=1)) < 0.002 * expected.max()
    assert np.mean(np.abs(mirrored - expected).max(axis=1) < 0.02 * expected.max()) > 0.95

    bright = seen(replace(lit, fixed=(mirror, matt)))[p[:, 1], p[:, 0]]
    shadowed = bright[:, 0] > mirrored[:, 0] + 0.1
    assert 0.05 < shadowed.mean() < 0.95, "some of what is mirrored lies in the shadow"


def _view(camera, places):
    """Unit directions (n, 3) in which a camera sees places."""
    view = places - camera.center
    return view / np.linalg.norm(view, axis=1)[:, None]


def _faces(camera, places, center, radius):
    """Which places on a ball (n,) a camera sees away from its outline, if nothing hides them."""
    return np.sum(_view(camera, places) * (center - places), axis=1) / radius > 0.3


def _clear(camera, places, center, radius):
    """Which places (n,) a camera sees past a ball, if nothing else hides them."""
    back = np.repeat(camera.center[None], len(places), axis=0)
    return nearest_ball(back, _view(camera, places), center, radius) == np.inf


@pytest.mark.parametrize("roughness", [0.02, 0.06, 0.12])
def test_a_rough_ball_shows_the_mean_of_what_its_facets_mirror(roughness) -> None:
    """Against the mean over all facets that are seen, each as large as it is seen."""
    rough = Material((0.0, 0.0, 0.0), 1.0, roughness)
    walled = scene(Sphere(CENTER, RADIUS, rough), walls=closed_room(texture=chequered))
    camera = walled.cameras[0]
    pixels, places, normals, _ = mirrored_rays(camera)
    some = np.linspace(0, len(pixels) - 1, 60).astype(int)
    found = seen(walled)[pixels[some, 1], pixels[some, 0]]
    expected = np.array(
        [
            _facet_mean(p, n, camera.center, roughness)
            for p, n in zip(places[some], normals[some], strict=True)
        ]
    )
    # The walls' colours differ by 0.8: an error of 0.06 is one facet in thirteen.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.06
    assert np.abs(found.mean(axis=0) - expected.mean(axis=0)).max() < 0.015


def _facet_mean(place, normal, viewer, roughness):
    view = (viewer - place) / np.linalg.norm(viewer - place)
    side = np.cross(normal, view) / max(np.linalg.norm(np.cross(normal, view)), 1e-12)
    frame = np.stack([np.cross(side, normal), side, normal])
    tilt = (np.arange(180) + 0.5) / 180 * np.arctan(6 * roughness)
    turn = (np.arange(120) + 0.5) / 120 * 2 * np.pi
    tilt, turn = np.meshgrid(tilt, turn)
    facets = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1)
    facets = facets.reshape(-1, 3)
    slope2 = np.tan(tilt.ravel()) ** 2
    density = np.exp(-slope2 / (2 * roughness**2)) / facets[:, 2] ** 4 * np.sin(tilt.ravel())
    towards = np.maximum(facets @ (frame @ view), 0)
    out = 2 * towards[:, None] * facets - frame @ view
    out[:, 2] = np.abs(out[:, 2])
    colours, _ = wall_colours(np.repeat(place[None], len(out), 0), out @ frame)
    weights = density * towards
    return weights @ colours / weights.sum()


def test_surroundings_fade_to_black_at_the_horizon() -> None:
    light = replace(EVEN, surround_rgb=(0.6, 0.8, 1.0))
    bare = scene(Sphere(CENTER, RADIUS, SMOOTH), light=light)
    pixels, _, _, on = mirrored_rays(bare.cameras[0])
    found = seen(bare)[pixels[:, 1], pixels[:, 0]]
    assert np.abs(found - np.maximum(on[:, 2:], 0) * (0.6, 0.8, 1.0)).max() < 1e-6


def test_glossy_balls_are_drawn_alike_whether_they_move_or_stand() -> None:
    plastic = replace(PLASTIC, albedo_rgb=(0.5, 0.2, 0.1))
    balls = (Sphere(CENTER, RADIUS, plastic), Sphere(beside(35, 0, 0), RADIUS, plastic))
    walls = closed_room(texture=chequered)
    still = scene(*balls, walls=walls)
    moving = scene(walls=walls, actors=(Actor(balls, Still(RigidTransform.identity())),))
    assert np.array_equal(seen(still), seen(moving))


def test_the_parts_of_a_long_exposure_share_the_facets_out() -> None:
    """Few facets in each of sixteen parts, and all of them in their mean."""
    camera = small_camera()
    rough = Material((0.0, 0.0, 0.0), 1.0, 0.08)
    shapes = (Sphere(CENTER, RADIUS, rough).moved(camera.camera_from_world),)
    walls = tuple(w.moved(camera.camera_from_world) for w in closed_room(texture=chequered))
    pixels = mirrored_rays(camera)[0].astype(float)
    rays = camera.intrinsics.unproject(pixels)
    ideal = (rays[:, :2] / rays[:, 2:])[:, None]
    near, delays = np.ones((1, len(ideal)), bool), np.zeros(len(ideal))

    def colours(*part):
        stage = Stage(shapes, EVEN, camera.intrinsics.focal_px, backdrop=walls, part=part)
        return stage.colours(ideal, near, delays)[0]

    whole, parts = colours(0, 1), [colours(k, 16) for k in range(16)]
    error = np.sqrt(np.mean((np.mean(parts, axis=0) - whole) ** 2))
    assert error < 0.03
    assert np.sqrt(np.mean((parts[0] - whole) ** 2)) > 3 * error
