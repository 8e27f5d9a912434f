"""Normal matrices that do not determine everything."""

from __future__ import annotations

import numpy as np

from measure.geometry.normal_equations import posterior_covariance, undetermined


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


def test_directions_that_stay_open_are_told() -> None:
    seen = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    limits = np.array([100.0, 100.0, 0.2])
    found = undetermined(1e4 * seen.T @ seen, limits)
    assert found.shape == (3, 1)
    np.testing.assert_allclose(np.abs(found[:, 0]), [70.71, 70.71, 0.0], atol=0.01)
    assert undetermined(1e4 * np.eye(3), limits).shape == (3, 0)  # negative control
    assert undetermined(np.diag([1e4, 1e4, 1.0]), limits).shape == (3, 1)
