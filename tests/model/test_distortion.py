"""The lens model against OpenCV's, its derivatives, its inverse, and its limits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import lenses, numeric_jacobian

from measure.model.distortion import distort_with_jacobians, fold_radius, undistort

IDEAL = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3)).map(np.array)


@given(lenses(), IDEAL)
def test_derivative_by_the_point(lens, ideal):
    _, by_point, _ = distort_with_jacobians(ideal[None], lens.distortion)
    numeric = numeric_jacobian(
        lambda p: distort_with_jacobians(p[None], lens.distortion)[0][0], ideal, 1e-6
    )
    np.testing.assert_allclose(by_point[0], numeric, atol=1e-7)


@given(lenses(), IDEAL)
def test_derivative_by_the_coefficients(lens, ideal):
    _, _, by_coefficient = distort_with_jacobians(ideal[None], lens.distortion)
    numeric = numeric_jacobian(
        lambda c: distort_with_jacobians(ideal[None], c)[0][0], lens.distortion, 1e-6
    )
    np.testing.assert_allclose(by_coefficient[0], numeric, atol=1e-7)


@given(lenses(), IDEAL)
def test_the_inverse_undoes(lens, ideal):
    assume(np.linalg.norm(ideal) < 0.95 * lens.reach)
    bent = distort_with_jacobians(ideal[None], lens.distortion)[0]
    np.testing.assert_allclose(undistort(bent, lens.distortion, lens.reach)[0], ideal, atol=1e-9)


@given(lenses())
def test_the_distorted_radius_grows_up_to_the_fold_and_no_further(lens):
    radial = lens.distortion * [1, 1, 0, 0, 1, 1, 1, 1]
    fold = fold_radius(radial)
    inside = np.linspace(0, min(fold, 10), 200)[:-1]
    radii = distort_with_jacobians(np.column_stack([inside, 0 * inside]), radial)[0][:, 0]
    assert np.all(np.diff(radii) > 0)
    if fold < 10:
        slopes = distort_with_jacobians(np.array([[fold * 0.999, 0], [fold * 1.001, 0]]), radial)[
            1
        ][:, 0, 0]
        assert slopes[1] < 0 or slopes[0] > 1e3  # it turns back, or runs off to infinity


def test_without_distortion_nothing_folds():
    assert fold_radius(np.zeros(8)) == np.inf


def test_a_known_fold():
    """r (1 - r^2) grows up to 1 / sqrt(3)."""
    assert fold_radius(np.array([-1.0, 0, 0, 0, 0, 0, 0, 0])) == pytest.approx(3**-0.5)


def test_beyond_the_fold_there_is_no_inverse():
    coefficients = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0])
    farthest = 3**-0.5 * (1 - 1 / 3)
    bent = np.array([[0.99 * farthest, 0], [1.01 * farthest, 0], [np.nan, 0]])
    ideal = undistort(bent, coefficients, fold_radius(coefficients))
    assert np.isfinite(ideal[0]).all()
    assert np.isnan(ideal[1:]).any(axis=1).all()


@given(lenses(), IDEAL)
def test_opencv_undistorts_to_the_same(lens, ideal):
    assume(np.linalg.norm(ideal) < 0.8 * lens.reach)
    bent = distort_with_jacobians(ideal[None], lens.distortion)[0]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    theirs = cv2.undistortPoints(bent, np.eye(3), lens.distortion, criteria=criteria)
    theirs = np.reshape(theirs, 2)
    back = distort_with_jacobians(theirs[None], lens.distortion)[0]
    assume(np.abs(back - bent).max() < 1e-9)  # their fixed-point iteration need not converge
    np.testing.assert_allclose(undistort(bent, lens.distortion, lens.reach)[0], theirs, atol=1e-6)
