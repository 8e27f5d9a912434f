"""How far out a lens model sees, and that it ends there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import lenses

from measure.model import Intrinsics

IDEAL = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3)).map(np.array)


def radial(*coefficients):
    """A lens of focal length 1 px without tangential distortion: k1 k2 k3 k4 k5 k6."""
    k1, k2, *more = (*coefficients, *[0.0] * (6 - len(coefficients)))
    return Intrinsics((3, 3), np.eye(3), np.array([k1, k2, 0, 0, *more]))


def at(lens, *radii):
    """Imaged radii of ideal ones."""
    return lens.project(np.column_stack([radii, np.zeros(len(radii)), np.ones(len(radii))]))[:, 0]


@given(lenses())
def test_the_distorted_radius_grows_up_to_the_fold_and_no_further(lens):
    lens = radial(*lens.distortion[[0, 1, 4, 5, 6, 7]])
    inside = np.linspace(0, min(lens.reach, 10), 200)[:-1]
    assert np.all(np.diff(at(lens, *inside)) > 0)
    if lens.reach < 10:
        near = at(lens, *(lens.reach * np.array([0.99998, 0.99999])))
        (beyond,) = at(lens, lens.reach)
        assert np.isnan(beyond)
        rise = np.diff(near)[0] / (1e-5 * lens.reach)
        assert rise < 0.1 or rise > 1e3  # it turns back, or runs off to infinity


def test_without_distortion_nothing_folds():
    assert radial().reach == np.inf


def test_a_known_fold():
    """r (1 - r^2) grows up to 1 / sqrt(3)."""
    assert radial(-1.0).reach == pytest.approx(3**-0.5)


def test_beyond_the_fold_there_is_no_inverse():
    farthest = 3**-0.5 * (1 - 1 / 3)
    bent = np.array([[0.99 * farthest, 0], [1.01 * farthest, 0], [np.nan, 0]])
    bearings = radial(-1.0).unproject(bent)
    assert np.isfinite(bearings[0]).all()
    assert np.isnan(bearings[1:]).any(axis=1).all()


@given(lenses(), IDEAL)
def test_opencv_undistorts_to_the_same(lens, ideal):
    assume(np.linalg.norm(ideal) < 0.8 * lens.reach)
    pixels = lens.project(np.array([[*ideal, 1.0]]))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    theirs = cv2.undistortPoints(pixels, lens.matrix, lens.distortion, criteria=criteria)
    theirs = np.append(np.reshape(theirs, 2), 1.0)
    back = lens.project(theirs[None])
    assume(np.abs(back - pixels).max() < 1e-7)  # their fixed-point iteration need not converge
    ours = lens.unproject(pixels)[0]
    np.testing.assert_allclose(ours / ours[2], theirs, atol=1e-6)
