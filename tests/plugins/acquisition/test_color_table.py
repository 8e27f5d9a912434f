from __future__ import annotations

import numpy as np
import pytest

from measure.model import BallColor
from measure_plugins._acquisition.color_table import classify, color_table


@pytest.mark.parametrize("step", [1, 2, 3, 4, 5])
def test_a_reduced_pixel_is_the_mean_of_the_four_in_the_middle_of_its_block(step):
    """Width and height that no step divides; random colours, so that every wrong pixel shows."""
    pixels = np.random.default_rng(step).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    table = color_table(tuple(BallColor.named(name) for name in ("red", "green", "yellow")))
    other = color_table((BallColor.named("blue"),))
    first = max(step // 2 - 1, 0)
    four = [
        pixels[y::step, x::step][: 37 // step, : 53 // step].astype(int)
        for y in {first, min(first + 1, step - 1)}
        for x in {first, min(first + 1, step - 1)}
    ]
    cut = np.mean(four, axis=0).astype(int) // 4
    expected = table[cut[..., 0], cut[..., 1], cut[..., 2]]
    assert 0 < np.count_nonzero(expected) < expected.size
    some, _ = classify(pixels, other, table, step)
    every, sparse = classify(pixels, table, other, step)
    assert np.array_equal(every, expected)
    assert np.array_equal(sparse, some[::2, ::2])
    assert not np.array_equal(sparse, expected[::2, ::2])
