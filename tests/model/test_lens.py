"""The compiled lens model: rays of pixels, many at once and one by one."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import lenses, numeric_jacobian

from measure.model.lens import RAY, bearing, fill_rays, ideal_point

IN_VIEW = st.lists(
    st.tuples(st.floats(-0.35, 0.35), st.floats(-0.2, 0.2), st.just(1.0)), min_size=1, max_size=20
).map(np.array)


def _rays(lens, pixels, start, end):
    out = np.full((RAY, len(pixels)), 7.0)
    fill_rays(pixels, start, end, lens.row, out)
    return out


@given(lenses(), IN_VIEW)
def test_rays_go_back_to_the_pixels_and_tell_their_derivatives(lens, points):
    assume(np.max(np.linalg.norm(points[:, :2], axis=1)) < 0.8 * lens.reach)
    rays = _rays(lens, lens.project(points), 0, len(points))
    bearings = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(rays[:3].T, bearings, atol=1e-9)
    for ray, slopes in zip(bearings, rays[3:].T, strict=True):
        by_bearing = numeric_jacobian(lambda v: lens.project(v[None])[0], ray, 1e-6)
        np.testing.assert_allclose(slopes.reshape(2, 3), by_bearing, rtol=1e-5, atol=1e-2)


def test_pixels_without_a_ray_leave_the_others_theirs(webcam):
    """The lens model bends nothing to so far away; the pixels before and behind are another's."""
    pixels = np.array([[600.0, 300.0], [620, 310], [1e6, 0], [np.nan, 5], [640, 320], [660, 330]])
    rays = _rays(webcam, pixels, 1, 5)
    assert np.isnan(rays[:, 2:4]).any(axis=0).all()
    assert np.isnan(rays[0, 2:4]).all()
    np.testing.assert_allclose(webcam.project(rays[:3, [1, 4]].T), pixels[[1, 4]], atol=1e-9)
    assert np.all(rays[:, [0, 5]] == 7.0)


@given(lenses(), IN_VIEW)
def test_inverses_point_by_point_undo_it(lens, points):
    assume(np.max(np.linalg.norm(points[:, :2], axis=1)) < 0.8 * lens.reach)
    pixels = lens.project(points)
    bearings = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose([bearing(pixel, lens.row) for pixel in pixels], bearings, atol=1e-9)
    ideal = [ideal_point(pixel, lens.row, lens.reach) for pixel in pixels]
    np.testing.assert_allclose(ideal, points[:, :2], atol=1e-9)
