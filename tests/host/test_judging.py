"""The covariance that is fitted to recordings left out, of how few they are."""

from __future__ import annotations

import numpy as np

from measure.host.judging import DOUBTS, Judged, Trust

ROWS = 40


def test_the_shape_of_six_recordings_offsets_is_not_taken_as_known() -> None:
    """By chance they hardly differ in some direction, in which those of the seventh do."""
    rng = np.random.default_rng(0)
    squared, inside = [], []
    for _ in range(100):
        offsets = rng.normal(0, 0.5, (6, 3))
        left = (offsets[:, None] + rng.normal(0, 0.3, (6, ROWS, 3))).reshape(-1, 3)
        none, doubts = np.zeros((len(left), 3, 3)), np.zeros((len(left), DOUBTS))
        trust = Trust.of(Judged(left, left, none, doubts, offsets))
        new = rng.normal(0, 0.5, (100, 3)) + rng.normal(0, 0.3, (100, 3))
        length = (new * np.linalg.solve(trust.growth[0] * trust.moment, new.T).T).sum(axis=1)
        squared.append(length.mean() / 3.0)
        inside.append((length < 7.815).mean())
    assert 1.0 < np.sqrt(np.mean(squared)) < 1.17  # 1.22 if they are
    assert 0.87 < np.mean(inside) < 0.95  # 0.84
