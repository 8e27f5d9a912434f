"""The cone tangent to a ball: exact fits on any arc, its covariance, and its ellipse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import directions, vectors

from measure.errors import DegenerateGeometryError
from measure.geometry import Cone, ellipse_of_conic, fit_cone, tangent_cone

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


# -- the image of the cone ------------------------------------------------------------------------


@given(st.floats(0, 1.2), st.floats(0, 6.28), st.floats(0.01, 0.3), st.floats(0, 6.28))
def test_the_ellipse_is_the_image_of_the_cone(off_axis, azimuth, half_angle, around):
    axis = np.array(
        [np.sin(off_axis) * np.cos(azimuth), np.sin(off_axis) * np.sin(azimuth), np.cos(off_axis)]
    )
    cone = Cone(axis, half_angle)
    ellipse = cone.ellipse()
    points = ellipse.points(around + np.arange(8))
    bearings = np.column_stack([points, np.ones(8)])
    np.testing.assert_allclose(cone.residuals(bearings), 0, atol=1e-8)
    assert ellipse.semi_axes[0] >= ellipse.semi_axes[1]
    assert -np.pi / 2 < ellipse.angle <= np.pi / 2


@pytest.mark.parametrize("off_axis_deg", [5, 10, 15, 20, 24])
@pytest.mark.parametrize("half_angle_deg", [1.0, 2.547, 8.0])
def test_the_ellipse_has_the_textbook_centre_and_axes(off_axis_deg, half_angle_deg):
    """For a ball `theta` off the axis, with focal length 1 (derived from the conic by hand)."""
    theta, alpha = np.radians(off_axis_deg), np.radians(half_angle_deg)
    ellipse = Cone(np.array([np.sin(theta), 0, np.cos(theta)]), alpha).ellipse()
    below = np.cos(theta) ** 2 - np.sin(alpha) ** 2
    offset = np.tan(theta) * np.sin(alpha) ** 2 / below
    np.testing.assert_allclose(ellipse.center, [np.tan(theta) + offset, 0], atol=1e-12)
    np.testing.assert_allclose(
        ellipse.semi_axes,
        [np.sin(alpha) * np.cos(alpha) / below, np.sin(alpha) / np.sqrt(below)],
        rtol=1e-9,
    )
    assert ellipse.angle == pytest.approx(0)


def test_the_centre_of_the_outline_is_not_the_centre_of_the_ball():
    """1420 px, 450 mm, 20 mm, 15 deg off axis: 0.81 px, which is 0.26 mm at the ball."""
    theta, alpha = np.radians(15), np.arcsin(20 / 450)
    ellipse = Cone(np.array([np.sin(theta), 0, np.cos(theta)]), float(alpha)).ellipse()
    assert 1420 * (ellipse.center[0] - np.tan(theta)) == pytest.approx(0.81, abs=0.005)


def test_a_ball_beside_the_camera_has_no_ellipse():
    with pytest.raises(DegenerateGeometryError, match=r"85\.0 deg off the optical axis"):
        Cone(np.array([np.sin(np.radians(85)), 0, np.cos(np.radians(85))]), 0.2).ellipse()


def test_other_conics_are_refused():
    with pytest.raises(DegenerateGeometryError, match="differ in sign"):
        ellipse_of_conic(np.diag([1.0, -1, -1]))
    with pytest.raises(DegenerateGeometryError, match="no point"):
        ellipse_of_conic(np.eye(3))


@given(st.floats(0.1, 5), st.floats(0.02, 1), vectors(3), st.floats(-1.57, 1.57))
def test_an_ellipse_is_read_back_from_its_conic(long, ratio, center, angle):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shape = turn @ np.diag([1 / long**2, 1 / (long * ratio) ** 2]) @ turn.T
    to_center = np.hstack([np.eye(2), -center[:2, None]])
    conic = to_center.T @ shape @ to_center
    conic[2, 2] -= 1
    ellipse = ellipse_of_conic(-2.5 * conic)
    np.testing.assert_allclose(ellipse.center, center[:2], atol=1e-6)
    np.testing.assert_allclose(ellipse.semi_axes, [long, long * ratio], rtol=1e-6)
    if ratio < 0.99:
        assert np.tan(ellipse.angle - angle) == pytest.approx(0, abs=1e-6)
