"""The covariance that is fitted to recordings left out, of how few they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure_learning.onnx.judging import DOUBTS, Judged, Trust

ROWS = 40


def test_the_shape_of_six_recordings_offsets_is_not_taken_as_known() -> None:
    """By chance they hardly differ in some direction, in which those of the seventh do."""
    rng = np.random.default_rng(0)
    squared, inside = [], []
    for _ in range(100):
        offsets = rng.normal(0, 0.5, (6, 3))
        left = (offsets[:, None] + rng.normal(0, 0.3, (6, ROWS, 3))).reshape(-1, 3)
        none, doubts = np.zeros((len(left), 3, 3)), np.zeros((len(left), DOUBTS))
        trust = Trust.of(Judged(left, left, none, doubts, doubts[:, 0], np.repeat(range(6), ROWS)))
        new = rng.normal(0, 0.5, (100, 3)) + rng.normal(0, 0.3, (100, 3))
        length = (new * np.linalg.solve(trust.growth[0] * trust.moment, new.T).T).sum(axis=1)
        squared.append(length.mean() / 3.0)
        inside.append((length < 7.815).mean())
    assert 1.0 < np.sqrt(np.mean(squared)) < 1.17  # 1.22 if they are
    assert 0.87 < np.mean(inside) < 0.95  # 0.84


def test_what_differs_between_recordings_only_is_no_reason_to_doubt() -> None:
    """Simpson's paradox: a doubt of one kind of recording, which is hard for other reasons.

    Within each recording the second doubt tells the size of the error, the third nothing.
    """
    rng = np.random.default_rng(1)
    hard, rows = np.repeat([1.0, 1.0, 1.0, 3.0], 500), np.arange(2000)
    tells = rng.uniform(0, 1, 2000)
    left = hard[:, None] * np.sqrt(0.5 + 2.0 * tells)[:, None] * rng.normal(0, 0.5, (2000, 3))
    doubts = np.stack([hard + rng.uniform(-0.5, 0.5, 2000), tells, rng.uniform(0, 1, 2000)], axis=1)
    none = np.zeros((2000, 3, 3))
    judged = Judged(left, left, none, doubts, np.zeros(2000), rows // 500)
    confounded, telling, nothing = _swings(Trust.of(judged), doubts)
    assert telling > 2.0  # 5 is true
    assert confounded < 1.3
    assert 0.8 < nothing < 1.3
    pooled = Trust.of(replace(judged, recording=np.zeros(2000)))  # a recording for all
    assert _swings(pooled, doubts)[0] > 2.0


def _swings(trust: Trust, doubts: np.ndarray) -> np.ndarray:
    """How much larger the covariance is where each doubt is at its largest than at its least."""
    swings = []
    for column in range(DOUBTS):
        ends = np.tile(doubts.mean(axis=0), (2, 1))
        ends[:, column] = doubts[:, column].min(), doubts[:, column].max()
        low, high = trust.tilt.factor(ends) * (trust.growth[0] + trust.growth[1] * ends[:, 0])
        swings.append(high / low)
    return np.array(swings)


def test_unfamiliar_is_what_errs_more() -> None:
    rng = np.random.default_rng(2)
    far = rng.uniform(0.5, 1.5, 1000)
    left = np.where(far > 1.2, 3.0, 1.0)[:, None] * rng.normal(0, 1, (1000, 3))
    none, doubts = np.zeros((1000, 3, 3)), np.zeros((1000, DOUBTS))
    judged = Judged(left, left, none, doubts, far, np.arange(1000) // 250)
    assert Trust.of(judged).limit == 1.2
    alike = replace(judged, residuals_mm=rng.normal(0, 1, (1000, 3)) * (1 / far)[:, None])
    assert Trust.of(alike).limit == 1.5  # they err no more: only what is very far is unfamiliar
    near = replace(judged, strangeness=far / 1.5)
    assert Trust.of(near).limit == 1.2  # nothing is known of what lies beyond
