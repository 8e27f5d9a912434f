"""The fisheye model to 85 degrees off the axis: OpenCV's, its derivatives, its inverse, its end."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import numeric_jacobian

from measure.geometry import RigidTransform, fit_cone, tangent_cone
from measure.model import Camera, Intrinsics, Rig
from measure.model.lens import (
    RAY,
    bearing,
    by_lens,
    distort_point,
    distortion_slopes,
    fill_rays,
    ideal_point,
    to_pixel,
)

MATRIX = np.array([[350.0, 0, 641], [0, 352, 357], [0, 0, 1]])
BENT = st.tuples(*[st.floats(-size, size) for size in (0.08, 0.02, 0.008, 0.002)])


def fisheye(*coefficients: float) -> Intrinsics:
    return Intrinsics((1280, 720), MATRIX, np.array(coefficients), model="fisheye")


def _ray(off_axis: float, azimuth: float) -> np.ndarray:
    across = np.sin(off_axis)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(off_axis)])


RAYS = st.builds(_ray, st.floats(0, np.radians(85)), st.floats(-np.pi, np.pi))
LENSES = BENT.map(lambda k: fisheye(*k)).filter(lambda lens: lens.reach > np.tan(np.radians(86)))


@given(LENSES, RAYS)
def test_opencv_projects_to_the_same_pixel(lens, ray):
    points, (pixel,) = 500 * ray[None, None], lens.project(500 * ray[None])
    theirs, _ = cv2.fisheye.projectPoints(
        points, np.zeros(3), np.zeros(3), MATRIX, lens.distortion[:4]
    )
    np.testing.assert_allclose(pixel, theirs[0, 0], atol=1e-8)


@given(LENSES, RAYS)
def test_a_pixel_goes_back_to_its_ray_in_arrays_and_compiled(lens, ray):
    (pixel,) = lens.project(ray[None])
    rays, rig = np.empty((RAY, 1)), Rig.of([Camera("a", lens, RigidTransform.identity())])
    fill_rays(pixel[None], 0, 1, lens.row, rays)
    for back in (lens.unproject(pixel[None])[0], bearing(pixel, lens.row), rays[:3, 0]):
        np.testing.assert_allclose(back, ray, atol=1e-10)
    np.testing.assert_allclose(rig.rays(pixel[None]).directions[0], ray, atol=1e-10)
    np.testing.assert_allclose(to_pixel(*ray, lens.row), pixel, atol=1e-9)


@given(LENSES, RAYS)
def test_analytic_derivatives_are_the_numeric_ones(lens, ray):
    (pixel,), (by_point,), (by_intrinsics,) = lens.project_with_jacobians(ray[None])
    numeric = numeric_jacobian(lambda p: lens.project(p[None])[0], ray, 1e-7)
    np.testing.assert_allclose(by_point, numeric, rtol=1e-4, atol=1e-2)

    def changed(by: np.ndarray) -> np.ndarray:
        matrix = MATRIX + np.array([[by[0], 0, by[2]], [0, by[1], by[3]], [0, 0, 0]])
        bent = lens.distortion[:4] + by[4:8]
        return Intrinsics((1280, 720), matrix, bent, model="fisheye").project(ray[None])[0]

    numeric = numeric_jacobian(changed, np.zeros(12), 1e-6)
    np.testing.assert_allclose(by_intrinsics, numeric, rtol=1e-6, atol=1e-4)

    x, y = ray[:2] / ray[2]
    compiled, rays = np.zeros((2, 12)), np.empty((RAY, 1))
    by_lens(x, y, lens.row, compiled)
    np.testing.assert_allclose(compiled, by_intrinsics, rtol=1e-9, atol=1e-9)
    rig = Rig.of([Camera("a", lens, RigidTransform.identity())])
    np.testing.assert_allclose(rig.project(ray)[1][0], by_point, rtol=1e-9, atol=1e-6)
    fill_rays(pixel[None], 0, 1, lens.row, rays)
    np.testing.assert_allclose(rays[3:, 0].reshape(2, 3), by_point, rtol=1e-7, atol=1e-5)
    np.testing.assert_allclose(
        np.reshape(distortion_slopes(x, y, lens.row), (2, 2)),
        numeric_jacobian(lambda p: np.array(distort_point(*p, lens.row)), np.array([x, y]), 1e-7),
        rtol=1e-4,
        atol=1e-7,
    )


def test_an_outline_seventy_degrees_off_the_axis_leads_back_to_the_ball():
    lens, center = fisheye(-0.02, 0.003, 0, 0), 400 * _ray(np.radians(70), 0.4)
    back = lens.unproject(lens.outline(tangent_cone(center, 20.0), 24))
    np.testing.assert_allclose(fit_cone(back).center(20.0), center, atol=1e-6)


@pytest.mark.parametrize(("k1", "widest_deg"), [(0.0, 89.0), (-0.3, np.degrees(0.9**-0.5))])
def test_beyond_its_end_a_lens_sees_nothing(k1, widest_deg):
    """angle - 0.3 angle^3 turns back at 1 / sqrt(0.9) rad; nothing lies beyond the right angle."""
    lens = fisheye(k1, 0, 0, 0)
    inside, beyond, behind = (
        _ray(np.radians(deg), 0.3) for deg in (widest_deg - 0.1, widest_deg + 0.1, 120)
    )
    np.testing.assert_allclose(lens.unproject(lens.project(inside[None]))[0], inside, atol=1e-6)
    for ray in (beyond, behind):
        assert np.isnan(lens.project(ray[None])).all()
        assert np.isnan(to_pixel(*ray, lens.row)).all()
    end = np.radians(widest_deg)
    pixel = MATRIX[:2, 2] + np.array([351 * (end + k1 * end**3) + 2.0, 0])
    assert np.isnan(lens.unproject(pixel[None])).all()
    assert np.isnan(bearing(pixel, lens.row)).all()
    assert np.isnan(ideal_point(pixel, lens.row, lens.reach)).all()


@pytest.mark.parametrize("coefficients", [[0.1] * 5, [0.1] * 8])
def test_other_coefficients_are_refused(coefficients):
    with pytest.raises(ValueError, match="of a fisheye: expected 0 or 4 coefficients"):
        fisheye(*coefficients)
