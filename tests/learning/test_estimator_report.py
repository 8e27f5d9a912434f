"""An estimator that is too sure of itself is not called good."""

from __future__ import annotations

import numpy as np
import pytest

from measure_learning.core.scores import EstimatorEvaluation, Score
from measure_learning.report import judged_on, verdict


def _score(rms_mm: float) -> Score:
    return Score(100, rms_mm, rms_mm / 2, 2 * rms_mm, np.full(3, rms_mm), np.full(3, rms_mm))


@pytest.mark.parametrize(
    ("after_mm", "consistency", "unfamiliar", "tone", "said"),
    [
        (0.5, 1.1, 0.01, "good", None),
        (0.5, 9.0, 0.01, "doubtful", "But its errors are 3.0 times as large as it promises."),
        (0.5, 1.1, 0.60, "doubtful", "But it calls 60% of the test unlike its training."),
        (4.0, 1.1, 0.01, "doubtful", None),
        (7.0, 9.0, 0.01, "bad", "3.0 times as large"),
    ],
)
def test_the_verdict(after_mm, consistency, unfamiliar, tone, said):
    before, after = _score(6.0), _score(after_mm)
    change = after_mm / 6.0 - 1
    result = EstimatorEvaluation(before, after, change, change, consistency, unfamiliar, {}, ())
    found, sentence = verdict(result)
    assert found == tone
    moves = "rises" if after_mm > 6 else "falls"
    assert f"the error {moves} from 6.00 to {after_mm:.2f} mm RMS" in sentence
    assert (said or "RMS") in sentence
    assert ("But" in sentence) == (said is not None)


def _part(digest: str, *trajectories: str) -> dict[str, object]:
    return {"digest": digest, "trajectories": list(trajectories)}


@pytest.mark.parametrize(
    ("test", "said"),
    [
        (_part("t", "c"), "unseen trajectories"),
        (_part("v", "b"), "trajectories that training was stopped by"),
        (_part("t", "a", "c"), "labels between those learnt from (not on unseen trajectories)"),
    ],
)
def test_what_was_judged_on_is_said(test, said):
    data = {"training": _part("l", "a"), "validation": _part("v", "b"), "test": test}
    assert judged_on(data) == said
