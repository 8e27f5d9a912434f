from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._edges.linear import times


@pytest.mark.parametrize(("p", "q", "n"), [(1, 1, 1), (8, 27, 72), (6, 18, 36), (3, 8, 5)])
def test_small_products_are_those_of_numpy(p, q, n):
    rng = np.random.default_rng(q)
    matrix, rows, start = rng.normal(size=(p, q)), rng.normal(size=(q, n)), rng.normal(size=(p, n))
    out = start.copy()
    times(matrix, rows, out)
    assert out == pytest.approx(start + matrix @ rows, abs=1e-12)
