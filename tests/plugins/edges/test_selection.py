from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._edges.selection import NINE, halved, kth_smallest, median, median_rows


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
def test_halving_finds_the_upper_median(count):
    sizes = np.random.default_rng(count).exponential(size=count)
    upper = np.sort(sizes)[count // 2]
    assert halved(sizes) == pytest.approx(upper, abs=1e-6)
    assert halved(np.zeros(count)) == 0
