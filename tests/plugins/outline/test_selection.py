from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._kernels.selection import NINE, kth_smallest, median, median_rows, nearly_kth


@pytest.mark.parametrize("count", range(1, NINE + 1))
def test_medians_of_few_rows_are_those_of_numpy(count):
    rows = np.random.default_rng(count).normal(size=(NINE, 37))
    rows[:, ::5] = np.round(rows[:, ::5])  # ties
    wanted = np.median(rows[:count], axis=0)
    assert np.array_equal(median_rows(rows, count), wanted)


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_selections_are_those_of_a_sorted_array(count):
    values = np.random.default_rng(count).normal(size=count)
    assert median(values.copy(), count) == np.median(values)
    for k in range(count):
        assert kth_smallest(values.copy(), count, k) == np.sort(values)[k]


@pytest.mark.parametrize("count", [1, 2, 7, 216])
@pytest.mark.parametrize("unused", [0, 3])
def test_counting_finds_those_of_a_sorted_array_nearly(count, unused):
    sizes = np.random.default_rng(count).exponential(size=count)
    # What is not to count is given as less than all others.
    given = np.append(sizes, np.full(unused, -1.0))
    for k in {0, count // 2, count - 1}:
        assert nearly_kth(given, unused + k) == pytest.approx(np.sort(sizes)[k], abs=1e-6)
    assert nearly_kth(np.zeros(count), count // 2) == 0
