from __future__ import annotations

import numpy as np
import pytest

from measure.geometry.linear_kernels import inverse, solved, times


@pytest.mark.parametrize(("p", "q", "n"), [(1, 1, 1), (8, 27, 72), (6, 18, 36), (3, 8, 5)])
def test_small_products_are_those_of_numpy(p, q, n):
    rng = np.random.default_rng(q)
    matrix, rows, start = rng.normal(size=(p, q)), rng.normal(size=(q, n)), rng.normal(size=(p, n))
    out = start.copy()
    times(matrix, rows, out)
    assert out == pytest.approx(start + matrix @ rows, abs=1e-12)


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
