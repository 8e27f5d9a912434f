from __future__ import annotations

import numpy as np
import pytest

from measure.arrays import floats


def test_the_message_says_expected_and_actual():
    with pytest.raises(ValueError, match=r"points_world: expected shape \(n, 3\), got \(3,\)"):
        floats("points_world", [1, 2, 3], "n", 3)


@pytest.mark.parametrize("shape", [(3,), (2, 3), (4, 2, 3)])
def test_leading_dots_allow_any_batch(shape):
    assert floats("points", np.zeros(shape, np.float32), "...", 3).dtype == np.float64


@pytest.mark.parametrize("shape", [(), (4,), (3, 2)])
def test_the_trailing_axes_are_checked_behind_dots(shape):
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        floats("points", np.zeros(shape), "...", 3)


def test_text_is_refused_not_guessed():
    with pytest.raises(ValueError, match="x_mm"):
        floats("x_mm", ["a"], "n")
