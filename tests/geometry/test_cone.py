"""The cone tangent to a ball: exact fits on any arc, its covariance, and its ellipse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import directions

from measure.errors import DegenerateGeometryError
from measure.geometry import Cone, fit_cone, tangent_cone

BALLS = st.tuples(directions(), st.floats(100, 3000), st.floats(5, 60))
"""Where a ball is: direction, distance in mm, radius in mm."""


@given(BALLS)
def test_the_cone_touches_the_ball(ball):
    direction, distance, radius = ball
    center = direction * distance
    v = tangent_cone(center, radius).bearings(np.linspace(0, 6, 12))
    foot = v * (v @ center)[:, None]
    np.testing.assert_allclose(np.linalg.norm(foot - center, axis=1), radius, rtol=1e-9)


@given(BALLS)
def test_the_centre_is_where_the_ball_was(ball):
    direction, distance, radius = ball
    cone = tangent_cone(direction * distance, radius)
    np.testing.assert_allclose(cone.center(radius), direction * distance, atol=1e-6)


@given(BALLS, st.floats(0, 6.28), st.floats(0.35, 6.28), st.integers(3, 60))
def test_any_exact_arc_gives_the_cone_back(ball, start, length, count):
    """20 degrees of the outline and three points are enough when they are exact."""
    direction, distance, radius = ball
    exact = tangent_cone(direction * distance, radius)
    arc = exact.bearings(start + np.linspace(0, min(length, 6.0), count))
    fitted = fit_cone(arc * np.linspace(0.5, 3, count)[:, None])  # lengths do not matter
    np.testing.assert_allclose(fitted.axis, exact.axis, atol=1e-9)
    assert fitted.half_angle == pytest.approx(exact.half_angle, rel=1e-6)
    np.testing.assert_allclose(fitted.residuals(arc), 0, atol=1e-10)


@given(BALLS, st.floats(1e-4, 1e-2))
def test_residuals_are_angles_outwards(ball, angle):
    direction, distance, radius = ball
    cone = tangent_cone(direction * distance, radius)
    wider = Cone(cone.axis, cone.half_angle + angle)
    np.testing.assert_allclose(cone.residuals(wider.bearings([0, 1, 4])), angle, rtol=1e-6)


@pytest.mark.parametrize("arc_deg", [360, 120])
def test_the_fitted_covariance_is_the_scatter(rng, arc_deg):
    exact = tangent_cone([60.0, -40, 450], 20.0)
    angles = np.radians(np.linspace(0, arc_deg, 64, endpoint=False))
    along, outward = exact.bearings(angles), _outward(exact, angles)
    fits = [fit_cone(along + rng.normal(scale=2e-4, size=(64, 1)) * outward) for _ in range(1500)]
    w = np.stack([fit.axis / np.cos(fit.half_angle) for fit in fits])
    predicted = np.mean([fit.covariance for fit in fits], axis=0)
    whitened = np.linalg.solve(np.linalg.cholesky(predicted), (w - w.mean(axis=0)).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.15)


def _outward(cone: Cone, angles) -> np.ndarray:
    """Unit vectors (n, 3) along which bearings on the cone leave it."""
    step = 1e-6
    wider = Cone(cone.axis, cone.half_angle + step)
    return (wider.bearings(angles) - cone.bearings(angles)) / step


def test_weights_tell_good_points_from_bad(rng):
    exact = tangent_cone([60.0, -40, 450], 20.0)
    points = exact.bearings(np.linspace(0, 6, 40))
    points[::4] += rng.normal(scale=1e-2, size=(10, 3))
    weights = np.ones(40)
    weights[::4] = 0
    np.testing.assert_allclose(fit_cone(points, weights).axis, exact.axis, atol=1e-12)
    assert np.abs(fit_cone(points).axis - exact.axis).max() > 1e-4


def test_points_without_a_bearing_are_left_out():
    exact = tangent_cone([60.0, -40, 450], 20.0)
    points = exact.bearings(np.linspace(0, 6, 10))
    points[3] = np.nan
    np.testing.assert_allclose(fit_cone(points, np.ones(10)).axis, exact.axis, atol=1e-12)


# -- degenerate input -----------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2])
def test_three_points_are_needed(count):
    with pytest.raises(DegenerateGeometryError, match=f"3 outline points, got {count}"):
        fit_cone(np.ones((count, 3)))


def test_points_of_weight_zero_are_no_points():
    with pytest.raises(DegenerateGeometryError, match="3 outline points, got 2"):
        fit_cone(tangent_cone([0, 0, 100.0], 10).bearings([0, 1, 2]), [1, 1, 0])


def test_points_on_a_straight_edge_are_refused():
    straight = np.column_stack([np.linspace(-0.1, 0.1, 9), np.zeros(9), np.ones(9)])
    with pytest.raises(DegenerateGeometryError, match="rank 2 of 3"):
        fit_cone(straight)


def test_one_point_seen_again_and_again_is_refused():
    with pytest.raises(DegenerateGeometryError):
        fit_cone(np.tile([0.1, 0.2, 1.0], (8, 1)))


def test_a_camera_inside_the_ball_has_no_cone():
    with pytest.raises(DegenerateGeometryError, match=r"distance 10\.0 mm, radius 20\.0 mm"):
        tangent_cone([0, 0, 10.0], 20.0)


def test_weights_of_another_length_are_refused():
    points = tangent_cone([0, 0, 100.0], 10).bearings([0, 1, 2])
    with pytest.raises(ValueError, match=r"weights: expected shape \(3\), got \(2,\)"):
        fit_cone(points, [1, 1])
