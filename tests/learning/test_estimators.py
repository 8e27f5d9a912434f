"""What every estimator must do; the built-in ones on a small simulated data set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from measure.errors import DivergedError, EstimatorError
from measure.host import Estimator, Registry
from measure.host.interfaces import quiet
from measure.robots import Reading, StateSchema
from measure_learning.core import Score, Split, evaluate
from measure_learning.onnx import OnnxModel

pytest.importorskip("torch", reason="training needs the extra 'train'")

SMALL_STREAM = {
    "perceptrons": 2, "perceptron_units": 16, "perceptron_epochs": 12, "grus": 2,
    "gru_units": 12, "gru_epochs": 60, "window": 32, "play_widths": 3,
}  # fmt: skip
CASES: list[tuple[str, dict[str, Any], float]] = [  # name, settings, RMS change to beat
    ("offset", {}, -0.5),
    ("ridge", {"features": "pose"}, -0.6),
    ("ridge", {"features": "window", "window": 4}, -0.6),
    ("ridge", {"features": "play", "play_widths": 4}, -0.6),
    ("mlp", {"layers": (40, 30), "epochs": 60, "batch": 64, "learning_rate": 5e-3}, -0.5),
    ("gp", {"points": 200, "tuning_points": 100}, -0.5),
    ("stream", SMALL_STREAM, -0.55),
]
IDS = [f"{name}-{settings.get('features', '')}".strip("-") for name, settings, _ in CASES]


@pytest.fixture(scope="module")
def fitted(split: Split) -> dict[str, Estimator]:
    registry = Registry.discover()
    out = {}
    for (name, settings, _), key in zip(CASES, IDS, strict=True):
        estimator = registry.build(Estimator, name, settings)
        estimator.folds = 0  # `test_left_out.py` is about those
        estimator.fit(split.train, split.validation, seed=0, report=quiet)
        out[key] = estimator
    return out


@pytest.mark.parametrize(
    ("key", "change"), [(k, c) for k, (_, _, c) in zip(IDS, CASES, strict=True)]
)
def test_learns_saves_and_streams(
    key: str, change: float, fitted: dict[str, Estimator], split: Split, tmp_path: Path
) -> None:
    estimator = fitted[key]
    estimator.save(tmp_path / "model.onnx", {"hello": "card"})
    model = OnnxModel.load(tmp_path / "model.onnx")
    assert model.card == {"hello": "card"}
    estimates = model.predict(split.test)
    result = evaluate(split.test, estimates)
    assert result.rms_change < change
    assert result.unfamiliar < 0.2
    assert np.linalg.eigvalsh(estimates.covariances).min() > 0
    assert 0.05 < result.consistency < 8.0
    # One state after another, from the estimator and from the file, gives the same numbers.
    name, rows = next(split.test.runs())
    assert name in split.test.names
    for source in (estimator, model, model):
        source.reset()
        for row in range(rows.start, rows.start + 40):
            answer = source.update(split.test.states[row], float(split.test.times_s[row]))
            np.testing.assert_allclose(answer.error_mm, estimates.errors_mm[row], atol=2e-4)
            np.testing.assert_allclose(answer.covariance, estimates.covariances[row], rtol=2e-3)


@pytest.mark.parametrize("key", IDS)
def test_unlike_training_is_flagged(key: str, fitted: dict[str, Estimator], split: Split) -> None:
    estimator = fitted[key]
    estimator.reset()
    state = split.test.states[100].copy()
    estimator.update(state, 0.0)
    far = state.copy()
    far[split.test.schema.index(["jpos_0"])] += 60.0
    assert estimator.update(far, 1.0).unfamiliar
    other_arm = state.copy()
    other_arm[split.test.schema.index(["type"])] = 10.0
    assert estimator.update(other_arm, 2.0).unfamiliar
    assert estimator.update(state * np.nan, 3.0).unfamiliar


def test_memory_pays(fitted: dict[str, Estimator], split: Split) -> None:
    """Apart from the constant by which the few trajectories of a restart are off."""

    def sd(key: str) -> float:
        estimates = fitted[key].model.predict(split.test)  # type: ignore[attr-defined]
        return Score.of((split.test.errors_mm - estimates.errors_mm)[split.test.usable]).sd_mm

    assert sd("ridge-play") < sd("ridge-pose") < sd("offset")


def test_the_clock_of_the_memory_is_that_of_training(
    fitted: dict[str, Estimator], split: Split
) -> None:
    """States ten times as often must not make the memory run ten times as fast."""
    estimator = fitted["stream"]
    _, rows = next(split.test.runs())
    states, times = split.test.states[rows], split.test.times_s[rows]
    estimator.reset()
    slow = [estimator.update(s, float(t)).error_mm for s, t in zip(states, times, strict=True)]
    estimator.reset()
    fast = []
    for row in range(len(states)):
        for step in range(10):
            last = estimator.update(states[row], float(times[row]) + 0.001 * step)
            if step == 0:
                fast.append(last.error_mm)
    np.testing.assert_allclose(slow, fast, atol=1e-4)


def test_a_fit_that_diverges_is_refused(split: Split) -> None:
    """It used to be a model of NaN."""
    for rate in (1e10, 1e30):
        settings = {"layers": (4,), "epochs": 1, "batch": 64, "learning_rate": rate}
        estimator = Registry.discover().build(Estimator, "mlp", settings)
        with pytest.raises(DivergedError, match="of estimator 'mlp' diverged"):
            estimator.fit(split.train, split.validation, seed=0, report=quiet)


def test_bad_data_and_files_are_refused(
    fitted: dict[str, Estimator], split: Split, tmp_path: Path
) -> None:
    with pytest.raises(EstimatorError, match="is in training and validation"):
        fitted["offset"].fit(split.train, split.train, seed=0, report=quiet)
    with pytest.raises(EstimatorError, match="has not been fitted"):
        Registry.discover().build(Estimator, "offset", {}).reset()
    path = tmp_path / "model.onnx"
    fitted["ridge-play"].save(path, {})
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(EstimatorError, match=r"model.onnx: not a usable ONNX file"):
        OnnxModel.load(path)
    flipped = bytearray(content)
    flipped[len(content) // 3] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(EstimatorError, match=r"model.onnx: (damaged|not a usable ONNX file)"):
        OnnxModel.load(path)
    path.write_bytes(b"")
    with pytest.raises(EstimatorError, match="not a usable ONNX file"):
        OnnxModel.load(path)
    with pytest.raises(EstimatorError, match=r"none.onnx: no such file"):
        OnnxModel.load(tmp_path / "none.onnx")
    model = fitted["offset"].model  # type: ignore[attr-defined]
    schema = split.test.schema
    other = StateSchema("raven2-right", schema.features, schema.position)
    with pytest.raises(EstimatorError, match="trained for robot 'raven2-left', not 'raven2-right'"):
        model.check(other)
    fewer = StateSchema(schema.robot, schema.features[:-2], schema.position)
    with pytest.raises(EstimatorError, match="missing: jac_f_4, jac_f_5"):
        model.check(fewer)
    chain = schema.chain
    moved, rounded = chain.tool.copy(), chain.tool.copy()
    moved[2, 3] += 5.0
    rounded[2, 3] *= 1 + 1e-15  # as another processor computes it
    model.check(replace(schema, chain=replace(chain, tool=rounded)))
    for another in (
        {"features": tuple(replace(f, unit="deg") for f in schema.features)},
        {"joints": tuple(Reading.of(r.terms[0][0], 0.1) for r in schema.joints)},
        {"chain": replace(chain, tool=moved)},
        {"chain": None},
    ):
        with pytest.raises(EstimatorError, match="another description of robot 'raven2-left'"):
            model.check(replace(schema, **another))  # type: ignore[arg-type]
