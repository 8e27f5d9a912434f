"""Robust losses: laws that hold for all, and the efficiency that their constants promise."""

from __future__ import annotations

import numpy as np
import pytest

from measure.estimation.losses import HUBER_SIGMAS, Huber, student_weights, tukey_weights


def test_a_huber_loss_is_square_within_its_reach_and_straight_beyond() -> None:
    loss, squares = Huber(2.0), Huber()
    assert loss.cost(np.array([1.5])) == squares.cost(np.array([1.5])) == 2.25
    ten, eleven, twelve = (loss.cost(np.array([length])) for length in (10.0, 11.0, 12.0))
    assert eleven - ten == twelve - eleven == 4.0
    np.testing.assert_array_equal(loss.weights(np.array([0.0, 2.0, 8.0])), [1.0, 1.0, 0.25])
    np.testing.assert_array_equal(squares.weights(np.array([0.0, 9e9])), [1.0, 1.0])


def test_weights_are_the_slope_of_the_loss_over_that_of_the_square() -> None:
    lengths, step = np.linspace(0.1, 9.0, 40), 1e-6
    loss = Huber(HUBER_SIGMAS)
    for length, weight in zip(lengths, loss.weights(lengths), strict=True):
        ends = (loss.cost(np.array([length + half])) for half in (-step, step))
        assert weight == pytest.approx(-np.subtract(*ends) / (4 * step * length), rel=1e-6)


def test_of_normal_residuals_little_is_lost_and_of_a_far_one_everything() -> None:
    """Asymptotic efficiencies at the normal distribution by its integrals."""
    x = np.linspace(-9, 9, 20001)
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    for weights, least in (
        (Huber(HUBER_SIGMAS).weights(np.abs(x)), 0.99),
        (tukey_weights(x**2), 0.949),
        (student_weights(x**2), 0.9),
    ):
        influence = weights * x
        slope = np.trapezoid(np.gradient(influence, x) * density, x)
        assert least < slope**2 / np.trapezoid(influence**2 * density, x) <= 1.0
    assert tukey_weights(np.array([4.6**2]))[0] > 0 == tukey_weights(np.array([4.7**2]))[0]
    assert student_weights(np.array([1e6]))[0] < 1e-5
