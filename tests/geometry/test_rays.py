"""Lines and the points nearest to them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import directions, vectors

from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, nearest_point


def through(point, origins) -> Rays:
    return Rays(origins, point - origins)


@given(vectors(), directions(), vectors(), st.floats(-800, 800))
def test_the_distance_does_not_depend_on_the_place_along_the_line(origin, direction, point, shift):
    here = Rays(origin, direction).distances(point)
    there = Rays(origin + shift * direction, direction).distances(point)
    np.testing.assert_allclose(here, there, atol=1e-6)


@given(vectors(), directions(), vectors())
def test_the_distance_is_by_pythagoras(origin, direction, point):
    along = (point - origin) @ direction
    square = np.sum((point - origin) ** 2) - along**2
    np.testing.assert_allclose(
        Rays(origin, direction).distances(point) ** 2, max(square, 0), atol=1e-6
    )


def test_rays_that_meet_are_answered_exactly(rng):
    point, origins = np.array([10.0, -20, 30]), rng.normal(scale=400, size=(5, 3))
    np.testing.assert_allclose(nearest_point(through(point, origins)), point, atol=1e-9)


def test_for_two_lines_the_nearest_point_is_the_middle_of_the_perpendicular(rng):
    rays = Rays(rng.normal(scale=400, size=(2, 3)), rng.normal(size=(2, 3)))
    (o1, o2), (d1, d2) = rays.origins, rays.directions
    along = np.linalg.solve(np.stack([d1, -d2, np.cross(d1, d2)], axis=1), o2 - o1)
    feet = np.stack([o1 + along[0] * d1, o2 + along[1] * d2])
    np.testing.assert_allclose(nearest_point(rays), feet.mean(axis=0), atol=1e-9)


def test_the_nearest_point_minimises_the_weighted_squares(rng):
    rays = Rays(rng.normal(scale=400, size=(4, 3)), rng.normal(size=(4, 3)))
    weights = np.array([1.0, 5, 0.2, 3])

    def cost(point):
        return weights @ rays.distances(point) ** 2

    best = nearest_point(rays, weights)
    for axis in np.eye(3):
        assert cost(best) < cost(best + axis)
        assert cost(best) < cost(best - axis)
        assert cost(best + 1e-3 * axis) == pytest.approx(cost(best - 1e-3 * axis), rel=1e-9)


def test_parallel_rays_are_refused_with_their_angle():
    rays = Rays(np.array([[0.0, 0, 0], [100, 0, 0]]), np.array([[0.0, 0, 1], [0, 2e-5, 1]]))
    with pytest.raises(DegenerateGeometryError, match="2 rays are parallel"):
        nearest_point(rays)


@pytest.mark.parametrize("count", [0, 1])
def test_one_ray_has_no_point(count):
    rays = Rays(np.zeros((count, 3)), np.ones((count, 3)))
    with pytest.raises(DegenerateGeometryError, match=f"needs 2 rays, got {count}"):
        nearest_point(rays)


def test_a_ray_without_direction_is_refused():
    with pytest.raises(DegenerateGeometryError, match="1 of 2 rays have a direction of length 0"):
        Rays(np.zeros((2, 3)), np.array([[0.0, 0, 0], [0, 0, 1]]))


def test_a_ray_that_is_not_there_stays_nan():
    rays = Rays(np.zeros((2, 3)), np.array([[np.nan] * 3, [0, 0, 5.0]]))
    assert np.isnan(rays.distances(np.ones(3)))[0]
    np.testing.assert_allclose(rays.directions[1], [0, 0, 1])
