from __future__ import annotations

import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.estimation.least_squares import Group, Linearised, solve
from measure.estimation.losses import Huber


def problem(x: Floats, y: Floats, state: tuple[Floats, Floats]) -> Linearised:
    """Lines y = a x + b_i of one slope a and an offset b_i for each row of y (f, n)."""
    (a,), offsets = state
    rows, points = y.shape
    residuals = (y - a * x - offsets[:, None]).reshape(-1, 1)
    by_shared = np.tile(x, rows).reshape(-1, 1, 1)
    block = np.repeat(np.arange(rows), points)
    group = Group(residuals, {"slope": by_shared}, block, np.ones((rows * points, 1, 1)))
    return Linearised((group,), {"slope": 1}, rows)


def fit(x: Floats, y: Floats, loss: Huber | None = None) -> tuple[Floats, Floats, Floats]:
    solution = solve(
        lambda state: problem(x, y, state),
        lambda state, shared, own: (state[0] + shared["slope"], state[1] + own[:, 0]),
        (np.zeros(1), np.zeros(len(y))),
        loss,
    )
    return solution.state[0], solution.state[1], solution.covariance


def test_elimination_of_blocks_equals_the_full_normal_equations() -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 7)
    y = 2.5 * x + rng.normal(size=(5, 1)) + rng.normal(0, 0.1, (5, 7))
    slope, offsets, covariance = fit(x, y)
    design = np.column_stack([np.tile(x, 5), np.kron(np.eye(5), np.ones((7, 1)))])
    full = np.linalg.lstsq(design, y.ravel(), rcond=None)[0]
    np.testing.assert_allclose([*slope, *offsets], full, rtol=1e-9)
    np.testing.assert_allclose(covariance[0, 0], np.linalg.inv(design.T @ design)[0, 0], rtol=1e-9)


def test_huber_shrugs_off_an_outlier() -> None:
    x = np.linspace(0, 1, 11)
    y = np.tile(3 * x, (2, 1)) + 0.01 * np.sin(np.arange(22)).reshape(2, 11)
    y[0, 10] += 50
    assert abs(fit(x, y)[0][0] - 3) > 1
    assert abs(fit(x, y, Huber(0.03))[0][0] - 3) < 0.05


def test_undetermined_parameters_are_refused() -> None:
    with pytest.raises(CalibrationError, match="undetermined"):
        fit(np.zeros(4), np.ones((2, 4)))
