"""Uncertain transforms: analytic derivatives, and predicted covariance against scatter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import covariances, numeric_jacobian, transforms, vectors

from measure.geometry import (
    RigidTransform,
    UncertainTransform,
    propagate,
    skew,
    squared_mahalanobis,
)
from measure.geometry.covariance import posterior_covariance, undetermined


@given(transforms(), covariances())
def test_the_covariance_of_an_inverse_is_that_of_its_derivative(a, covariance):
    jacobian = numeric_jacobian(
        lambda d: a.perturb(d).inverse().difference(a.inverse()), np.zeros(6), 1e-5
    )
    analytic = UncertainTransform(a, covariance).inverse().covariance
    expected = propagate(jacobian, covariance)
    np.testing.assert_allclose(analytic, expected, atol=1e-6 * np.abs(expected).max())


@given(transforms(), transforms(), covariances(), covariances())
def test_the_covariance_of_a_composition_is_that_of_its_derivatives(a, b, cov_a, cov_b):
    by_a = numeric_jacobian(lambda d: (a.perturb(d) @ b).difference(a @ b), np.zeros(6), 1e-5)
    by_b = numeric_jacobian(lambda d: (a @ b.perturb(d)).difference(a @ b), np.zeros(6), 1e-5)
    expected = propagate(by_a, cov_a) + propagate(by_b, cov_b)
    composed = UncertainTransform(a, cov_a) @ UncertainTransform(b, cov_b)
    np.testing.assert_allclose(composed.covariance, expected, atol=1e-6 * np.abs(expected).max())


@given(transforms(), covariances(), vectors(100))
def test_the_covariance_of_a_point_is_that_of_its_derivative(a, covariance, point):
    jacobian = numeric_jacobian(lambda d: a.perturb(d).apply(point), np.zeros(6), 1e-5)
    actual = UncertainTransform(a, covariance).point_covariance(point)
    np.testing.assert_allclose(actual, propagate(jacobian, covariance), atol=1e-4)


@given(transforms(), covariances())
def test_inverting_twice_gives_the_covariance_back(a, covariance):
    twice = UncertainTransform(a, covariance).inverse().inverse()
    np.testing.assert_allclose(twice.covariance, covariance, atol=1e-6)


def test_predicted_covariance_is_the_scatter_of_a_chain(rng):
    """world_from_camera and camera_from_body drawn 20 000 times; the scatter of their product."""
    sd = np.array([0.3, 0.2, 0.5, 2e-3, 1e-3, 3e-3])
    world_from_camera = RigidTransform.from_rotvec([0.3, -1.2, 2.0], [300, -200, 150])
    camera_from_body = RigidTransform.from_rotvec([2.5, 1.0, -0.4], [20, -35, 450])
    a, b = (UncertainTransform(t, np.diag(sd**2)) for t in (world_from_camera, camera_from_body))
    draws = rng.normal(size=(2, 20_000, 6)) * sd
    scattered = world_from_camera.perturb(draws[0]) @ camera_from_body.perturb(draws[1])
    composed = a @ b
    steps = scattered.difference(composed.transform)
    whitened = np.linalg.solve(np.linalg.cholesky(composed.covariance), steps.T)
    # 20 000 draws: entries of the whitened scatter have a standard error of 0.007 to 0.01.
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.05)
    assert np.mean(squared_mahalanobis(steps, composed.covariance)) == pytest.approx(6, rel=0.03)


def test_a_wrong_chart_would_not_pass(rng):
    """Negative control: the same scatter does not fit a covariance written in the source frame."""
    sd = np.array([0.3, 0.2, 0.5, 2e-3, 1e-3, 3e-3])
    a = RigidTransform.from_rotvec([0.3, -1.2, 2.0], [300, -200, 150])
    steps = a.perturb(rng.normal(size=(20_000, 6)) * sd).difference(a)
    turned = np.kron(np.eye(2), a.rotation)
    wrong = propagate(turned.T, np.diag(sd**2))
    assert np.mean(squared_mahalanobis(steps, wrong)) > 8


def test_mahalanobis_counts_standard_deviations():
    squares = squared_mahalanobis(np.array([[2.0, 0], [0, 3]]), np.diag([4.0, 1.0]))
    np.testing.assert_allclose(squares, [1, 9])


def test_skew_of_a_turned_point_links_the_two_charts():
    a = RigidTransform.from_rotvec([0.1, 0.2, 0.3], [1, 2, 3])
    np.testing.assert_allclose(
        skew(a.rotate([1.0, 2, 3])), a.rotation @ skew([1.0, 2, 3]) @ a.rotation.T, atol=1e-12
    )


def test_a_covariance_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"covariance: expected shape \(6, 6\), got \(3, 3\)"):
        UncertainTransform(RigidTransform.identity(), np.eye(3))


def test_what_data_and_prior_say_together() -> None:
    """Of any units: the sum of a shift and a turn is seen, their difference is not."""
    seen = np.array([[1.0, 0.01]])
    prior = np.array([1e3, 10.0])
    P = posterior_covariance(1e8 * seen.T @ seen, prior**-2.0)
    np.testing.assert_allclose(
        np.linalg.inv(P), 1e8 * seen.T @ seen + np.diag(prior**-2.0), rtol=1e-6
    )
    assert (seen @ P @ seen.T).item() < 1.1e-8
    assert P[0, 0] > 1e-3
    free = posterior_covariance(np.diag([4.0, 0.0]), np.zeros(2))
    np.testing.assert_allclose(free, np.diag([0.25, 0.0]))


def test_directions_that_stay_open_are_named() -> None:
    seen = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    limits = np.array([100.0, 100.0, 0.2])
    found = undetermined(posterior_covariance(1e4 * seen.T @ seen, np.full(3, 1e-6)), limits)
    assert found.shape == (3, 1)
    np.testing.assert_allclose(np.abs(found[:, 0]), [70.71, 70.71, 0.0], atol=0.01)
    assert undetermined(1e-4 * np.eye(3), limits).shape == (3, 0)  # negative control
    assert undetermined(np.diag([1e-4, 1e-4, 1.0]), limits).shape == (3, 1)
