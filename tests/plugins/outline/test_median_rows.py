from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.sampling.edge_crossing import median_rows


@pytest.mark.parametrize("count", range(1, 10))
def test_medians_of_few_rows_are_those_of_numpy(count):
    rows = np.random.default_rng(count).normal(size=(count, 37))
    rows[:, ::5] = np.round(rows[:, ::5])  # ties
    wanted = np.median(rows, axis=0)
    assert np.array_equal(median_rows(rows), wanted)
