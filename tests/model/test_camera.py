"""Cameras: OpenCV's projection, analytic derivatives, rays that go back, and points not seen."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import cameras, lenses, numeric_jacobian

from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, fit_cone, propagate, tangent_cone
from measure.model import Camera, Intrinsics, Rig
from tests.scenes import RAVEN, TARGET, ring

IN_VIEW = st.tuples(st.floats(-0.45, 0.45), st.floats(-0.25, 0.25), st.floats(100, 2000)).map(
    lambda t: np.array([t[0] * t[2], t[1] * t[2], t[2]])
)
"""Points in the camera frame that a webcam would see, mm."""


def _inside_reach(lens: Intrinsics, point: np.ndarray) -> bool:
    return bool(np.linalg.norm(point[:2]) / point[2] < 0.9 * lens.reach)


@given(cameras(), st.lists(IN_VIEW, min_size=1, max_size=5))
def test_opencv_projects_to_the_same_pixels(camera, points):
    assume(all(_inside_reach(camera.intrinsics, p) for p in points))
    world = camera.world_from_camera.apply(np.stack(points))
    inverse = camera.camera_from_world
    theirs, _ = cv2.projectPoints(
        world,
        inverse.rotvec,
        inverse.translation,
        camera.intrinsics.matrix,
        camera.intrinsics.distortion,
    )
    np.testing.assert_allclose(camera.project(world), np.reshape(theirs, (-1, 2)), atol=1e-6)


@given(cameras(), IN_VIEW)
def test_analytic_derivatives_are_the_numeric_ones(camera, point):
    assume(_inside_reach(camera.intrinsics, point))
    world = camera.world_from_camera.apply(point)
    _, by_world, by_pose, by_intrinsics = camera.project_with_jacobians(world[None])

    def at_pose(delta):
        moved = Camera("x", camera.intrinsics, camera.world_from_camera.perturb(delta))
        return moved.project(world[None])[0]

    scale = camera.intrinsics.focal_px / point[2]
    np.testing.assert_allclose(
        by_world[0],
        numeric_jacobian(lambda p: camera.project(p[None])[0], world, 1e-3),
        atol=1e-4 * scale,
    )
    numeric = numeric_jacobian(at_pose, np.zeros(6), 1e-6)
    np.testing.assert_allclose(by_pose[0], numeric, rtol=1e-4, atol=1e-2 * scale)
    start = _parameters(camera.intrinsics)
    numeric = numeric_jacobian(lambda q: _with_parameters(q).project(point[None])[0], start, 1e-6)
    np.testing.assert_allclose(by_intrinsics[0], numeric, rtol=1e-4, atol=1e-3)


def _parameters(lens: Intrinsics) -> np.ndarray:
    m = lens.matrix
    return np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens.distortion])


def _with_parameters(q: np.ndarray) -> Intrinsics:
    return Intrinsics((1280, 720), np.array([[q[0], 0, q[2]], [0, q[1], q[3]], [0, 0, 1]]), q[4:])


@given(cameras(), IN_VIEW)
def test_a_ray_goes_back_through_the_point(camera, point):
    assume(_inside_reach(camera.intrinsics, point))
    world = camera.world_from_camera.apply(point)
    rays = camera.rays(camera.project(world[None]))
    assert rays.distances(world[None])[0] < 1e-6 * point[2]
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1)
    assert rays.directions[0] @ (world - camera.center) > 0


@given(lenses(), st.floats(-1.55, 1.55), st.floats(0, 6.28))
def test_whatever_has_an_image_is_found_again_there(lens, off_axis, azimuth):
    """A ball far aside must not appear in the image because the polynomial folds back."""
    bearing = np.array(
        [np.sin(off_axis) * np.cos(azimuth), np.sin(off_axis) * np.sin(azimuth), np.cos(off_axis)]
    )
    pixel = lens.project(bearing[None])
    assume(np.isfinite(pixel).all() and lens.contains(pixel).all())
    back = lens.unproject(pixel)
    assume(np.isfinite(back).all())
    np.testing.assert_allclose(back[0], bearing, atol=1e-7)


def test_a_point_far_aside_has_no_image(webcam):
    """60 deg aside, this lens' polynomial would put it into the picture."""
    aside = np.array([[np.tan(np.radians(60)), 0, 1.0]])
    assert np.isnan(webcam.project(aside)).all()


def test_points_behind_the_camera_have_no_image(webcam):
    points = np.array([[0, 0, -100.0], [10, 0, 0], [0, 0, 100]])
    pixels, by_point, by_intrinsics = webcam.project_with_jacobians(points)
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], webcam.matrix[:2, 2])
    assert np.isnan(by_point[:2]).any(axis=(1, 2)).all()
    assert np.isfinite(by_point[2]).all()
    assert np.isfinite(by_intrinsics[2]).all()


def test_a_pixel_that_is_not_there_has_no_bearing(webcam):
    bearings = webcam.unproject([[np.nan, 3.0], [600, 300], [1e6, 0]])
    assert np.isnan(bearings[0]).any()
    assert np.isfinite(bearings[1]).all()
    assert np.isnan(bearings[2]).any()


def test_no_points_are_no_pixels(webcam):
    assert webcam.project(np.zeros((0, 3))).shape == (0, 2)
    assert webcam.unproject(np.zeros((0, 2))).shape == (0, 3)


def test_contains_counts_pixel_centres(webcam):
    pixels = np.array([[0, 0], [1279, 719], [-0.1, 5], [1279.1, 5], [np.nan, 5]])
    np.testing.assert_array_equal(webcam.contains(pixels), [1, 1, 0, 0, 0])
    np.testing.assert_array_equal(webcam.contains(pixels, margin_px=1), [0, 0, 0, 0, 0])


def test_skewed_pixels_go_back_too():
    lens = Intrinsics((1280, 720), np.array([[1400.0, 5, 640], [0, 1390, 360], [0, 0, 1]]))
    bearing = lens.unproject([[900, 200]])
    np.testing.assert_allclose(lens.project(500 * bearing), [[900, 200]], atol=1e-9)


@pytest.mark.parametrize("count", [1, 3, 6, 12, 14])
def test_other_numbers_of_coefficients_are_refused(count):
    with pytest.raises(ValueError, match=f"0, 4, 5 or 8 coefficients, got {count}"):
        Intrinsics((1280, 720), np.eye(3), np.zeros(count))


def test_predicted_covariance_is_the_scatter_of_pixels(rng, rig):
    """An uncertain camera pose, propagated by the derivative, against 20 000 draws."""
    camera, point = rig[1], np.array([[25.0, -40, 10]])
    sd = np.array([0.2, 0.3, 0.1, 4e-4, 6e-4, 2e-4])
    _, _, by_pose, _ = camera.project_with_jacobians(point)
    predicted = propagate(by_pose[0], np.diag(sd**2))
    poses = camera.world_from_camera.perturb(rng.normal(size=(20_000, 6)) * sd)
    seen = poses.inverse().apply(point)
    scatter = np.cov(camera.intrinsics.project(seen).T)
    np.testing.assert_allclose(scatter, predicted, rtol=0.05, atol=0.02 * np.trace(predicted))


# -- outlines -------------------------------------------------------------------------------------


def test_the_outline_is_where_rays_touch_the_ball(rig):
    for camera in rig:
        center = np.array([30.0, -20, 15])
        rays = camera.rays(camera.outline(center, 20.0))
        np.testing.assert_allclose(rays.distances(center), 20.0, atol=1e-7)


@given(cameras(), IN_VIEW)
def test_a_distorted_outline_leads_back_to_the_ball(camera, center):
    assume(_inside_reach(camera.intrinsics, center * [1.2, 1.2, 1]))
    cone = tangent_cone(center, 20.0)
    assume(np.isfinite(outline := camera.intrinsics.outline(cone, 24)).all())
    back = camera.intrinsics.unproject(outline)
    assume(np.isfinite(back).all())
    np.testing.assert_allclose(fit_cone(back).center(20.0), center, atol=1e-4)


def test_a_camera_inside_a_ball_sees_no_outline(rig):
    with pytest.raises(DegenerateGeometryError, match="inside the ball"):
        rig[0].outline(rig[0].center, 20.0)


def test_the_rig_looks_at_the_origin(rig):
    for camera in rig:
        assert np.linalg.norm(camera.center) == pytest.approx(450)
        pixel = camera.project(np.zeros((1, 3)))[0]
        np.testing.assert_allclose(pixel, camera.intrinsics.matrix[:2, 2], atol=1e-6)
        above = camera.project(np.array([[0.0, 0, 30]]))[0]
        assert above[1] < pixel[1], "the world's up is up in the picture"
    assert isinstance(rig[0].world_from_camera, RigidTransform)


def test_projects_like_each_camera():
    cameras = ring()
    rig = Rig.of(list(cameras.values()))
    points = TARGET + RAVEN.centers[[0, 1, 2, 0]]
    pixels, by_world = rig.project(points)
    for i, camera in enumerate(cameras.values()):
        expected, expected_by_world, _, _ = camera.project_with_jacobians(points[i : i + 1])
        np.testing.assert_allclose(pixels[i], expected[0], atol=1e-9)
        np.testing.assert_allclose(by_world[i], expected_by_world[0], atol=1e-9)


def test_rays_go_back_through_the_point():
    rig = Rig.of(list(ring().values()))
    pixels, _ = rig.project(TARGET)
    np.testing.assert_allclose(rig.rays(pixels).distances(TARGET), 0, atol=1e-6)


def test_a_point_behind_a_camera_has_no_pixel():
    rig = Rig.of(list(ring().values()))
    behind_first = rig.centers[0] + (rig.centers[0] - TARGET)
    pixels, _ = rig.project(behind_first)
    assert np.all(np.isnan(pixels[0]))
    assert np.all(np.isfinite(pixels[2]))


def test_take_keeps_order():
    rig = Rig.of(list(ring().values()))
    assert rig.take([2, 0]).names == ("cam2", "cam0")
    np.testing.assert_array_equal(rig.take([2, 0]).centers, rig.centers[[2, 0]])
