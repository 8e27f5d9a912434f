from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure import api
from measure.host import OnnxModel
from measure.learning import (
    PAPER_MINUTES,
    PAPER_PAIRS,
    AssemblySettings,
    Score,
    assemble,
    evaluate,
    rezero,
    simulated_dataset,
)
from measure.learning.simulated import recording
from measure.robots.simulator import Cables, simulate


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
    assert path.stat().st_size < 2_000_000
    assert model.card["settings"] == model.facts["settings"]
    assert "measure train" in model.card["command"]
    assert model.card["revision"]
    assert "dirty" not in model.card["revision"]
    assert f"RMS {model.card['scores']['rms_change']:+.1%}" in card_text


@pytest.mark.slow
def test_the_scores_on_its_card_are_true() -> None:
    """A session of its data is simulated again; a test trajectory scores what the card says."""
    model = OnnxModel.load(api.shipped_model())
    name, (before, after) = next(iter(model.card["scores"]["by_trajectory"].items()))
    session = int(name.removeprefix("session_").partition("/")[0])
    edges = np.round(np.linspace(0, PAPER_PAIRS, 5)).astype(int)
    pairs, seconds = int(np.diff(edges)[session]), 60.0 * PAPER_MINUTES / 4
    run = simulate(seconds, 1000 + session, log_hz=50.0)
    made = recording(
        run, f"session_{session:02d}", 1 + session, frame_hz=pairs / (seconds - 0.25), pairs=pairs
    )
    data, _ = assemble([made], AssemblySettings(cut_s=210.0))
    assert name in model.card["data"]["test"]["trajectories"]
    assert name not in model.card["data"]["training"]["trajectories"]
    part = data.select([name])
    result = evaluate(part, model.predict(part))
    assert result.before.rms_mm == pytest.approx(before["rms_mm"], rel=1e-3)
    assert result.after.rms_mm == pytest.approx(after["rms_mm"], rel=1e-2)
    assert result.after.rows == after["rows"]


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
