from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure.host import Dataset
from measure_learning import api
from measure_learning.core import (
    PAPER_MINUTES,
    PAPER_PAIRS,
    LabelKind,
    Score,
    evaluate,
    rezero,
    simulated_dataset,
)
from measure_learning.onnx import OnnxModel
from measure_learning.simulator import Cables


def test_the_shipped_network_corrects_a_restart_it_has_not_seen() -> None:
    """Without torch: onnxruntime is enough to use it."""
    result = api.correct_simulated_robot(seconds=40.0, seed=11)
    assert result.before.rms_mm > 4.0
    assert result.rms_change < -0.75
    assert result.unfamiliar < 0.05


def test_the_shipped_network_says_what_it_is() -> None:
    path = api.shipped_model()
    model = OnnxModel.load(path)
    assert model.robot == "raven2-left"
    assert len(model.features) == 118
    assert "simulated" in model.card["about"]
    assert model.card["data"]["training"]["digest"]
    card_text = path.with_suffix(".card.md").read_text()
    assert "simulated" in card_text
    assert path.stat().st_size < 2_500_000
    assert model.card["settings"] == model.facts["settings"]
    assert "measure train" in model.card["command"]
    assert model.card["revision"]
    assert "dirty" not in model.card["revision"]
    assert f"RMS {model.card['scores']['rms_change']:+.1%}" in card_text


@pytest.mark.slow
def test_the_scores_on_its_card_are_true() -> None:
    """Six restarts that it has not seen, judged by the true tip at the true time, once more."""
    model = OnnxModel.load(api.shipped_model())
    pairs = round(30.0 * PAPER_PAIRS / PAPER_MINUTES)
    exact = LabelKind(exact=True)
    data, _ = simulated_dataset(minutes=30, pairs=pairs, restarts=6, seed=101, labels=exact)
    assert list(data.present()) == model.card["data"]["test"]["trajectories"]
    assert not set(data.present()) & set(model.card["data"]["training"]["trajectories"])
    result, scores = evaluate(data, model.predict(data)), model.card["scores"]
    assert result.before.rms_mm == pytest.approx(scores["before"]["rms_mm"], rel=1e-3)
    assert result.after.rms_mm == pytest.approx(scores["after"]["rms_mm"], rel=1e-2)
    assert result.after.rows == scores["after"]["rows"]


def test_it_is_fast_enough_for_a_kilohertz() -> None:
    """In CPU time: other work on the machine does not count."""
    import time

    model = OnnxModel.load(api.shipped_model())
    state = np.zeros((1, 118))
    for index in range(200):
        model.update(state[0], 0.001 * index)
    begun = time.process_time()
    for index in range(1000):
        model.update(state[0], 1.0 + 0.001 * index)
    assert (time.process_time() - begun) / 1000 < 500e-6


def test_a_restart_is_no_drift_but_worn_cables_are() -> None:
    """A measured minute removes from the next one, by the true tip, most of what a restart left.

    Where cables have worn to twice the slack and friction, no joint offset is consistent any more,
    or what is left is larger than stated.
    """
    model = OnnxModel.load(api.shipped_model())
    fresh, true, worn = (
        simulated_dataset(
            minutes=2.0, pairs=706, restarts=1, seed=21, cables=Cables(wear=wear), labels=kind
        )[0]
        for wear, kind in ((1.0, LabelKind()), (1.0, LabelKind(exact=True)), (2.0, LabelKind()))
    )
    early = fresh.times_s - fresh.times_s[0] < 60.0
    zeroing, monitor = rezero(model, replace(fresh, usable=fresh.usable & early))
    assert not monitor.due
    left = true.errors_mm - model.predict(true).errors_mm
    late = true.times_s - true.times_s[0] >= 60.0
    before = Score.of(left[late]).rms_mm
    after = Score.of((left - zeroing.offset_mm(true.states))[late]).rms_mm
    assert after < min(0.65 * before, 0.7)
    assert zeroing.sd_mm < 0.15
    assert not _doubted(model, fresh)
    assert _doubted(model, worn)


def _doubted(model: OnnxModel, data: Dataset) -> bool:
    try:
        return rezero(model, data)[1].due
    except EstimatorError:
        return True
