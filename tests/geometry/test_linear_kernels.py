from __future__ import annotations

import numpy as np
import pytest

from measure.geometry.linear_kernels import inverse, invert_scaled, solved


def test_inverses_are_those_of_numpy():
    rows = np.random.default_rng(0).normal(size=(20, 12)) * np.geomspace(1e-3, 1e3, 12)
    matrix = rows.T @ rows
    assert inverse(matrix) @ matrix == pytest.approx(np.eye(12), abs=1e-6)
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), rtol=1e-6, atol=0)
    right = rows.sum(axis=0)
    np.testing.assert_allclose(solved(matrix, right), np.linalg.solve(matrix, right), rtol=1e-6)


def test_what_is_not_positive_has_no_inverse():
    assert np.isnan(inverse(np.diag([1.0, 0.0]))).all()
    assert np.isnan(inverse(np.diag([1.0, np.nan]))).all()
    assert np.isnan(solved(np.diag([1.0, -1.0]), np.ones(2))).all()


def test_scaled_inverses_are_those_of_numpy_and_say_how_well_unknowns_are_told_apart():
    rows = np.random.default_rng(0).normal(size=(20, 9)) * np.geomspace(1e-6, 1e6, 9)
    matrix, out = rows.T @ rows, np.empty((9, 9))
    inflation = invert_scaled(np.tril(matrix), out)
    unit = 1 / np.sqrt(np.diag(matrix))
    alike = np.linalg.inv(matrix * np.outer(unit, unit))
    np.testing.assert_allclose(out, alike * np.outer(unit, unit), rtol=1e-9, atol=0)
    assert inflation == pytest.approx(np.max(np.diag(alike)))
    rows[:, 8] = 1e12 * rows[:, 0] * (1 + 1e-5 * np.sin(np.arange(20)))
    assert 1e8 < invert_scaled(rows.T @ rows, out) < 1e12


@pytest.mark.parametrize("last", [0.0, -1.0, np.nan, np.inf])
def test_unknowns_that_the_equations_leave_open_are_infinitely_inflated(last):
    out = np.empty((3, 3))
    assert invert_scaled(np.diag([2.0, 1.0, last]), out) == np.inf
    assert np.all(out == 0)
