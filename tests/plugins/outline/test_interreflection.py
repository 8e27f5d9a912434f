"""Another ball right behind an outline: where it is mirrored, and what that does to edges."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.appearance.interreflection import (
    add_ball_reflection,
    ball_reflection_shares,
    balls_behind,
)
from measure_plugins._outline.appearance.model import (
    DEFAULT_CORRECTION_WEIGHT,
    GLOSSY,
    MATT,
    Appearance,
    first_appearance,
)
from measure_plugins._outline.appearance.point_lights import shade_by_lights
from measure_plugins._outline.appearance.radial_basis import DEFLECTIONS, radial_tables
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.fitting.edges import (
    PredictionInputs,
    corrected_edges,
    find_edge_pairs,
)
from measure_plugins._outline.sampling.rays import (
    angles_around,
    cast_rays,
    frame_about,
    middle_angles,
)
from tests.plugins.outline.estimates import cones
from tests.plugins.rendering import picture, scenes

RAYS = 72
STEP = np.radians(10.0)


def test_balls_behind_are_given_in_radii():
    one, far, near = (np.array([x, 0.0, z]) for x, z in [(0, 500), (30, 540), (-20, 450)])
    found = balls_behind(_cone(one, 10.0), np.array([_cone(one, 10), _cone(far, 15), _cone(near)]))
    assert found == pytest.approx(np.array([[3.0, 0.0, 4.0, 1.5]]))


def _cone(center, radius=10.0):
    distance = np.linalg.norm(center)
    return np.array([*(center / distance), np.arcsin(radius / distance), distance])


@pytest.mark.parametrize("seed", range(6))
def test_shares_of_the_ball_behind_follow_geometry(seed):
    rng = np.random.default_rng(seed)
    center, radius = np.array([*rng.uniform(-100, 100, 2), rng.uniform(300, 600)]), 16.0
    behind = center * 1.1 + rng.uniform(-20, 20, 3)
    cone = _cone(center, radius)
    frame, around = frame_about(cone[:3]), angles_around(RAYS)
    balls = balls_behind(cone, np.array([cone, _cone(behind, radius)]))
    shares = ball_reflection_shares(balls, frame, cone[3], around)
    if shares.size == 0:
        shares = np.full((len(DEFLECTIONS), RAYS), -1.0)
    bends = np.radians(np.arange(0, 90, 0.02))
    for i in range(RAYS):
        outward = around[i] @ frame[:2]
        normal = np.cos(cone[3]) * outward - np.sin(cone[3]) * frame[2]
        view = np.cos(cone[3]) * frame[2] + np.sin(cone[3]) * outward
        ways = np.cos(bends)[:, None] * view + np.sin(bends)[:, None] * normal
        to_ball = behind - (center + radius * normal)
        meets = np.linalg.norm(np.cross(ways, to_ball), axis=1) < radius
        if not meets[0]:
            assert np.all(shares[:, i] == -1)
            continue
        ends = bends[np.argmin(meets)]  # the first line that passes it by
        wanted = np.clip((ends - DEFLECTIONS) / STEP + 0.5, 0, 1)
        assert shares[:, i] == pytest.approx(wanted, abs=3e-3)


def test_geometry_is_tried_with_balls_before_each_other():
    """Else the test above would compare nothing."""
    cone, behind = _cone(np.array([0.0, 0, 400]), 16), _cone(np.array([0.0, 20, 440]), 16)
    balls = balls_behind(cone, np.array([cone, behind]))
    shares = ball_reflection_shares(balls, frame_about(cone[:3]), cone[3], angles_around(RAYS))
    assert 10 < np.count_nonzero(shares[0] > 0) < 40
    assert (
        ball_reflection_shares(balls[:0], frame_about(cone[:3]), cone[3], angles_around(RAYS)).size
        == 0
    )


def test_the_first_of_several_balls_behind_is_mirrored():
    cone = _cone(np.array([0.0, 0, 400]), 16)
    near, far = _cone(np.array([0.0, 20, 440]), 16), _cone(np.array([0.0, 30, 520]), 16)
    frame, around = frame_about(cone[:3]), angles_around(RAYS)

    def shares(*others):
        balls = balls_behind(cone, np.array([cone, *others]))
        return ball_reflection_shares(balls, frame, cone[3], around)

    alone, further = shares(near), shares(far)
    both = (alone[0] > 0) & (further[0] > 0)
    assert np.count_nonzero(both) > 5
    assert np.abs(alone - further)[:, both].max() > 0.2
    for found in (shares(near, far), shares(far, near)):
        assert np.array_equal(found, np.where(alone[0] > 0, alone, further))


@pytest.mark.parametrize(("index", "mirrors"), [(MATT, True), (GLOSSY, False)])
def test_balls_that_mirror_no_surroundings_mirror_no_ball(index, mirrors):
    tables = radial_tables(60.0, 0.045, 1.0, index, mirrors)
    shares, light = (
        np.ones((len(DEFLECTIONS), 4)),
        np.full((3, len(tables.grazing_reflection), 4), 0.2),
    )
    background = np.tile([[0.9], [0.5], [0.1]], 4)
    grey = np.full(4, 0.5 * np.sqrt(3))
    add_ball_reflection(shares, background, grey, tables, 0, light)
    assert light == pytest.approx(np.full(light.shape, 0.2), abs=1e-3)
    add_ball_reflection(shares, background, grey, radial_tables(60.0, 0.045, 1.0, GLOSSY), 0, light)
    assert np.abs(light - 0.2).max() > 0.02


@pytest.fixture(scope="module")
def view():
    """Picture and outlines of a camera that sees the green ball before the yellow one."""
    scene, name = scenes()["still"], "cam3"
    camera = scene.camera(name)
    names = [ball.name for ball in scene.body.balls]
    rows = np.array([[*axis, half, mm] for axis, half, mm in cones(scene, camera, 0.0)])
    pixels = picture(scene, name, 0.0)
    return pixels, camera.intrinsics.row, rows, names.index("green")


def test_reflection_of_the_ball_behind_reduces_edge_error(view):
    with_it, without = _mean_error(view, True), _mean_error(view, False)
    assert without > 0.4, "surroundings that went on would be mirrored further"
    assert abs(with_it) < 0.5 * without


def _mean_error(view, known):
    """Mean px by which edges lie outside the green ball's true outline, before the yellow one."""
    pixels, lens, rows, green = view
    appearance: Appearance = first_appearance("srgb")
    axis, half_angle = rows[green, :3], rows[green, 3]
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, RAYS, lens)
    tables = appearance.tables(half_angle * float(np.mean(scale)), half_angle)
    middles = middle_angles(rays.around)
    shares = ball_reflection_shares(balls_behind(rows[green], rows), frame, half_angle, middles)
    lit = shade_by_lights(tables.diffuse, tables.fresnel_loss[0], middles, appearance.point_lights)
    used = shares if known else shares[:, :0].copy()
    ambient = Ambient(lit, used)
    inputs = PredictionInputs(pixels, appearance.table, appearance.encoding, rays, tables, ambient)
    found = find_edge_pairs(inputs)
    edges = corrected_edges(found, DEFAULT_CORRECTION_WEIGHT)
    before = np.repeat(shares[0] > 0, RAYS // len(middles))
    good = before & (np.abs(edges.shifts) < 2.0)
    assert np.count_nonzero(good) > 8
    return float(np.mean(edges.shifts[good]))
