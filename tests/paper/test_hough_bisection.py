"""The accumulator threshold on Hough functions made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from measure_paper._hough_steps import tune_blur, tune_threshold


class FakeHough:
    """Circles with known votes: a threshold returns those that have more."""

    def __init__(self, *votes):
        self.votes = sorted(votes, reverse=True)
        self.tried = []

    def __call__(self, threshold):
        self.tried.append(threshold)
        kept = [vote for vote in self.votes if vote > threshold]
        return np.array([[index, 0.0, vote] for index, vote in enumerate(kept)]).reshape(-1, 3)


@pytest.mark.parametrize("start", [5, 12, 40, 64, 500])
def test_finds_the_edge_between_one_and_two_circles(start):
    tuned = tune_threshold(FakeHough(83, 37, 20), 1, lowest=5, start=start)
    assert tuned.threshold == 37
    assert len(tuned.circles) == 1
    assert not tuned.jumped


@pytest.mark.parametrize(("expected", "edge"), [(1, 90), (2, 60), (3, 41), (4, 17)])
def test_finds_the_edge_between_k_and_k_plus_one(expected, edge):
    tuned = tune_threshold(FakeHough(120, 90, 60, 41, 17), expected, lowest=5, start=64)
    assert (tuned.threshold, len(tuned.circles)) == (edge, expected)


def test_a_lone_circle_is_found_at_the_lowest_threshold():
    tuned = tune_threshold(FakeHough(30), 1, lowest=6, start=64)
    assert (tuned.threshold, len(tuned.circles), tuned.jumped) == (6, 1, False)


def test_nothing_to_find_is_not_a_jump():
    hough = FakeHough(4, 3)
    tuned = tune_threshold(hough, 1, lowest=6, start=64)
    assert (len(tuned.circles), tuned.jumped) == (0, False)
    assert min(hough.tried) == 6


def test_equal_votes_are_a_jump_from_none_to_two():
    tuned = tune_threshold(FakeHough(50, 50), 1, lowest=5, start=64)
    assert tuned.jumped
    assert tuned.threshold == 50
    assert len(tuned.circles) == 0


@given(
    votes=st.lists(st.integers(1, 300), max_size=12),
    expected=st.integers(1, 4),
    lowest=st.integers(1, 20),
    start=st.integers(1, 400),
)
def test_result_is_the_lowest_threshold_with_no_more_than_expected(votes, expected, lowest, start):
    hough = FakeHough(*votes)
    tuned = tune_threshold(hough, expected, lowest, start)
    assert len(tuned.circles) <= expected
    assert len(hough(tuned.threshold)) == len(tuned.circles)
    if tuned.threshold > lowest:
        assert len(hough(tuned.threshold - 1)) > expected
        assert tuned.jumped == (len(tuned.circles) < expected)
    else:
        assert tuned.threshold == lowest
        assert not tuned.jumped


def blurred(by_sigma, used):
    def find_with(sigma):
        used.append(sigma)
        return FakeHough(*by_sigma[sigma])

    return find_with


def test_blur_stays_when_there_is_no_jump():
    used = []
    tuned = tune_blur(blurred({1.5: (80, 30), 2.0: (70,)}, used), [1.5, 2.0], 1, 5, 64)
    assert used == [1.5]
    assert tuned.sigma_px == 1.5


def test_blur_stays_when_nothing_is_found():
    used = []
    tuned = tune_blur(blurred({1.5: (), 2.0: (70,)}, used), [1.5, 2.0], 1, 5, 64)
    assert used == [1.5]
    assert len(tuned.circles) == 0


def test_blur_rises_only_until_the_jump_is_gone():
    used = []
    by_sigma = {1.5: (50, 50), 2.0: (44, 44), 2.5: (60, 31), 3.0: (90,)}
    tuned = tune_blur(blurred(by_sigma, used), [1.5, 2.0, 2.5, 3.0], 1, 5, 64)
    assert used == [1.5, 2.0, 2.5]
    assert (tuned.sigma_px, tuned.threshold, tuned.jumped) == (2.5, 31, False)


def test_gives_up_after_the_largest_blur():
    used = []
    tuned = tune_blur(blurred({1.5: (50, 50), 2.0: (44, 44)}, used), [1.5, 2.0], 1, 5, 64)
    assert used == [1.5, 2.0]
    assert tuned.jumped
    assert len(tuned.circles) == 0
