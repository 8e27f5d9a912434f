from __future__ import annotations

import numpy as np

from measure import api
from measure.host import OnnxModel


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
    assert "simulated" in path.with_suffix(".card.md").read_text()
    assert path.stat().st_size < 2_000_000


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
    from measure.learning import rezero, simulated_dataset
    from measure.robots.simulator import Cables

    model = OnnxModel.load(api.shipped_model())
    fresh, worn = (
        simulated_dataset(minutes=2.0, pairs=700, restarts=1, seed=21, cables=Cables(wear=wear))[0]
        for wear in (1.0, 1.6)
    )
    offset, sd, monitor = rezero(model, fresh)
    assert not monitor.due
    assert sd.max() < 0.1
    estimates = model.predict(fresh)
    left = fresh.errors_mm - estimates.errors_mm
    before, after = (np.sqrt((r**2).sum(axis=1).mean()) for r in (left, left - offset))
    assert after < 0.8 * before
    assert rezero(model, worn)[2].due
