"""The covariance that is fitted to recordings left out, of how few they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure_learning.onnx.judging import INGREDIENTS, Judged, Trust

ROWS = 40


def judged_of(left: np.ndarray, recording: np.ndarray, tells: np.ndarray | None = None) -> Judged:
    """Residuals of exact labels, of states as near as all."""
    count = len(left)
    ingredients = np.tile([1.0, 0.0, 0.0], (count, 1))
    if tells is not None:
        ingredients[:, 1:] = tells
    assert ingredients.shape[1] == INGREDIENTS
    none = np.zeros((count, 3, 3))
    return Judged(left, left, none, ingredients, np.zeros(count), recording)


def test_the_shape_of_six_recordings_offsets_is_not_taken_as_known() -> None:
    """By chance they hardly differ in some direction, in which those of the seventh do."""
    rng = np.random.default_rng(0)
    squared, inside = [], []
    for _ in range(100):
        offsets = rng.normal(0, 0.5, (6, 3))
        left = (offsets[:, None] + rng.normal(0, 0.3, (6, ROWS, 3))).reshape(-1, 3)
        trust = Trust.of(judged_of(left, np.repeat(range(6), ROWS)))
        new = rng.normal(0, 0.5, (100, 3)) + rng.normal(0, 0.3, (100, 3))
        (covariance,) = trust.covariances(np.array([[1.0, 0.0, 0.0]]))
        length = (new * np.linalg.solve(covariance, new.T).T).sum(axis=1)
        squared.append(length.mean() / 3.0)
        inside.append((length < 7.815).mean())
    assert 0.85 < np.sqrt(np.mean(squared)) < 1.1
    assert 0.9 < np.mean(inside) < 0.97


def test_the_level_is_that_of_nine_in_ten_recordings() -> None:
    """One of ten that is three times as hard does not raise it; two do."""
    rng, place = np.random.default_rng(3), np.repeat(range(10), 300)
    for hard, least, most in ((1, 0.0, 0.8), (2, 0.88, 1.0)):
        sizes = np.where(np.arange(10) < hard, 3.0, 1.0)
        left = sizes[place][:, None] * rng.normal(0, 0.5, (3000, 3))
        judged = judged_of(left, place)
        held = Trust.of(judged).squared(judged) < 7.815
        shares = [held[place == one].mean() for one in range(10)]
        assert least < min(shares) < most
        assert np.median(shares) > 0.94


def test_what_differs_between_recordings_only_is_no_reason_to_doubt() -> None:
    """Simpson's paradox: strangeness of one kind of recording, which is hard for other reasons.

    Within each recording the estimator's own variance tells the size of the error.
    """
    rng, place = np.random.default_rng(1), np.arange(2000) // 500
    hard = np.repeat([1.0, 1.0, 1.0, 3.0], 500)
    own = rng.uniform(0, 1, 2000)
    left = hard[:, None] * np.sqrt(0.5 + 2.0 * own)[:, None] * rng.normal(0, 0.5, (2000, 3))
    tells = np.stack([hard + rng.uniform(-0.5, 0.5, 2000), own], axis=1)
    growth = Trust.of(judged_of(left, place, tells)).growth
    assert growth[2] > 2.0 * growth[0]  # 4 is true
    assert growth[1] < 0.15 * growth[0]
    pooled = Trust.of(judged_of(left, np.zeros(2000), tells)).growth  # a recording for all
    assert pooled[1] > 0.2 * pooled[0]


def test_what_a_day_adds_is_no_growth_with_strangeness() -> None:
    """Recordings left out are strange and have offsets: a familiar state of a new day has both."""
    rng, place = np.random.default_rng(5), np.repeat(range(10), 200)
    strange = np.repeat(np.linspace(0.2, 2.0, 10), 200)
    offsets = rng.normal(0, 1.0, (10, 3)) * np.sqrt(strange[::200])[:, None]
    left = offsets[place] + rng.normal(0, 0.3, (2000, 3))
    trust = Trust.of(judged_of(left, place, np.stack([strange, 0.0 * strange], axis=1)))
    low, high = (np.trace(one) for one in trust.covariances(np.array([[1, 0.2, 0], [1, 2.0, 0]])))
    assert high < 1.2 * low
    assert low > np.trace(offsets.T @ offsets / 10)


def test_unfamiliar_is_what_errs_more() -> None:
    rng = np.random.default_rng(2)
    far = rng.uniform(0.5, 1.5, 1000)
    left = np.where(far > 1.2, 3.0, 1.0)[:, None] * rng.normal(0, 1, (1000, 3))
    judged = replace(judged_of(left, np.arange(1000) // 250), strangeness=far)
    assert Trust.of(judged).limit == 1.2
    alike = replace(judged, residuals_mm=rng.normal(0, 1, (1000, 3)) * (1 / far)[:, None])
    assert Trust.of(alike).limit == 1.5  # they err no more: only what is very far is unfamiliar
    near = replace(judged, strangeness=far / 1.5)
    assert Trust.of(near).limit == 1.2  # nothing is known of what lies beyond
