"""Long curves are thinned for drawing; what stands out in them is drawn all the same."""

from __future__ import annotations

import numpy as np
import pytest

from measure.viewing.report.figures import MAX_POINTS, thinned
from measure_lab.run_report import state_timeline

COUNT = 100_000


def test_few_are_all_drawn() -> None:
    assert thinned(MAX_POINTS, np.zeros(MAX_POINTS)).tolist() == list(range(MAX_POINTS))


@pytest.mark.parametrize("value", [1e3, -1e3, np.nan])
@pytest.mark.parametrize("at", [0, 1, 49_999, 77_777, COUNT - 1])
def test_a_single_outlier_or_gap_is_drawn(at: int, value: float) -> None:
    curve = np.sin(np.arange(COUNT) / 50)
    curve[at] = value
    kept = thinned(COUNT, curve)
    assert len(kept) <= MAX_POINTS + 2
    assert at in kept


def test_extremes_of_every_curve_are_drawn() -> None:
    curves = np.random.default_rng(1).normal(size=(3, COUNT))
    kept = thinned(COUNT, *curves)
    assert len(kept) <= MAX_POINTS + 2
    assert {int(k) for curve in curves for k in (curve.argmin(), curve.argmax())} <= set(kept)


def test_a_view_that_fails_once_is_shown_to_fail() -> None:
    codes = np.zeros((2, COUNT), dtype=np.int64)
    codes[1, 12_345] = 2
    times = np.arange(COUNT) / 30
    figure = state_timeline(times, codes, ["a", "b"], ["effective", "hidden", "out of sight"])
    shown = np.asarray(figure.data[0].z)
    assert shown.shape == (2, MAX_POINTS)
    assert not shown[0].any()
    assert np.count_nonzero(shown[1]) == 1
    assert times[np.flatnonzero(shown[1])[0] * COUNT // MAX_POINTS] == pytest.approx(411.5, abs=2)
