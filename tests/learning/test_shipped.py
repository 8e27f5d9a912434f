from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure import api
from measure.host import OnnxModel
from measure.learning import Score, rezero, simulated_dataset
from measure.robots.simulator import Cables


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


@pytest.mark.parametrize("seed", [21, 22])
def test_a_restart_is_no_drift_but_worn_cables_are(seed: int) -> None:
    """The first minute removes what a restart left from the next one."""
    model = OnnxModel.load(api.shipped_model())
    fresh, worn = (
        simulated_dataset(minutes=2.0, pairs=706, restarts=1, seed=seed, cables=Cables(wear=wear))[
            0
        ]
        for wear in (1.0, 1.4)
    )
    early = fresh.times_s - fresh.times_s[0] < 60.0
    zeroing, monitor = rezero(model, replace(fresh, usable=fresh.usable & early))
    assert not monitor.due
    left = fresh.errors_mm - model.predict(fresh).errors_mm
    judged = fresh.usable & ~early
    before = Score.of(left[judged]).rms_mm
    after = Score.of((left - zeroing.offset_mm(fresh.states))[judged]).rms_mm
    assert after < min(0.5 * before, 0.4)
    assert zeroing.sd_mm < 0.15
    assert not rezero(model, fresh)[1].due
    assert rezero(model, worn)[1].due
