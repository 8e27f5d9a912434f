"""States that are not what they are called: none is corrected with a small stated error."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import measure_learning
from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Correction, Dataset, Estimator, Registry
from measure.host.estimator import quiet
from measure_learning.core import (
    EstimateClient,
    EstimateServer,
    GuardedModel,
    Refusal,
    correct_file,
)
from measure_learning.onnx import OnnxModel
from measure_learning.robots import find_schema
from measure_learning.robots.tables import Table
from tests.learning.conftest import serving

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")

ROWS, MIDDLE = 150, np.array([0.1, -0.2, 0.14, 0.5, 0.3, -0.4])
SPANS = np.array([0.5, 0.4, 0.05, 1.2, 0.9, 0.9])
MM = np.array([1, 1, 1e3, 1, 1, 1])


def walks(names: list[str], seed: int) -> Dataset:
    """A dVRK arm whose joints err by an offset and a lag, in smooth motion."""
    rng, schema = np.random.default_rng(seed), find_schema("dvrk-psm")
    phases, rates = rng.uniform(0, 6, (len(names), 1, 6)), rng.uniform(0.5, 1.5, (len(names), 1, 6))
    times = 0.1 * np.arange(ROWS)
    q = (MIDDLE + SPANS * np.sin(phases + rates * times[None, :, None])).reshape(-1, 6)
    off = 0.02 * SPANS * MM * (1.0 + np.sign(np.gradient(q, axis=0)))
    tips = schema.chain.tip_mm(q * MM)
    errors = schema.chain.tip_mm(q * MM + off) - tips + rng.normal(0, 0.05, tips.shape)
    count = len(q)
    return Dataset(
        schema, np.hstack([q, tips]), np.tile(times, len(names)),
        np.repeat(np.arange(len(names)), ROWS), tuple(names), errors,
        np.tile(0.01 * np.eye(3), (count, 1, 1)), np.ones(count, dtype=bool),
    )  # fmt: skip


KNOWN, TODAY = walks([f"day{k}" for k in range(4)], 1), walks(["today"], 2)


def fitted(chain: bool) -> Estimator:
    estimator = Registry.discover().build(Estimator, "ridge", {"play_widths": 3})
    estimator.folds = 2
    schema = KNOWN.schema if chain else replace(KNOWN.schema, chain=None)
    data = replace(KNOWN, schema=schema)
    estimator.fit(data.select(data.names[:3]), data.select(data.names[3:]), seed=0, report=quiet)
    return estimator


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "ridge.onnx"
    fitted(chain=True).save(path, {})
    return path


def scaled(columns: list[int], factor: float) -> Callable[[Floats], Floats]:
    factors = np.ones(9)
    factors[columns] = factor
    return lambda states: states * factors


def exchanged(one: int, other: int) -> Callable[[Floats], Floats]:
    order = np.arange(9)
    order[[one, other]] = order[[other, one]]
    return lambda states: states[:, order]


def shuffled_joints(states: Floats) -> Floats:
    order = np.random.default_rng(3).permutation(len(states))
    return np.hstack([states[order, :6], states[:, 6:]])


def elsewhere(states: Floats) -> Floats:
    """An arm that reaches where it never was, and reports so."""
    q = states[:, :6] + [1.5, 1.2, 0.1, 0, 0, 0]
    return np.hstack([q, KNOWN.schema.chain.tip_mm(q * MM)])


CONTRADICTORY = {
    "joint negated": scaled([4], -1.0),
    "joint turned by 90 deg": lambda states: states + np.pi / 2 * np.eye(9)[3],
    "joints exchanged": exchanged(4, 5),
    "insertion in mm": scaled([2], 1e3),
    "joints in degrees": scaled([0, 1, 3, 4, 5], 180 / np.pi),
    "tip in m": scaled([6, 7, 8], 1e-3),
    "tip's axes exchanged": exchanged(6, 7),
    "tip's axis negated": scaled([8], -1.0),
    "rows of the joints shuffled": shuffled_joints,
}
UNITS = {"insertion in mm": "is its column in mm", "joints in degrees": "is its column in deg"}
OTHERS = {
    "not a number": (lambda states: states + np.nan * np.eye(9)[4], Refusal.NOT_A_NUMBER),
    "rows shuffled": (lambda states: states, Refusal.STALE),
    "where it never was": (elsewhere, "unfamiliar"),
}
CASES = {n: (c, Refusal.CONTRADICTORY) for n, c in CONTRADICTORY.items()} | OTHERS


def given(name: str) -> tuple[Floats, Floats, str]:
    change, status = CASES[name]
    states, times = change(TODAY.states), TODAY.times_s
    if name == "rows shuffled":
        order = np.random.default_rng(4).permutation(len(states))
        states, times = states[order], times[order]
    return states, times, str(status)


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_input_has_its_status_by_udp_and_in_a_file(
    name: str, model_path: Path, tmp_path: Path
) -> None:
    states, times, wanted = given(name)
    model = OnnxModel.load(model_path)
    with serving(EstimateServer(model, ("127.0.0.1", 0))) as server:
        client = EstimateClient(server.address, timeout_s=5.0)
        answers = [client.ask(s, t).answer for s, t in zip(states, times, strict=True)]
        client.close()
    said = [str(a) if isinstance(a, Refusal) else _word(a) for a in answers]
    apart = np.linalg.norm(
        model.schema.chain.tip_mm(model.schema.joint_positions(states)) - states[:, 6:], axis=1
    )
    clear = apart > 1.0 if wanted == Refusal.CONTRADICTORY else np.full(len(said), True)
    share = np.mean([word == wanted for word in np.array(said)[clear]])
    assert clear.mean() > 0.9
    assert share == 1.0 if name != "rows shuffled" else share > 0.4
    path, columns = tmp_path / "states.parquet", dict(zip(model.features, states.T, strict=True))
    parquet.write_table(pa.table({"t_s": times, **columns}), path)
    if name == "rows shuffled":
        with pytest.raises(EstimatorError, match="of 150 stamps are not after the one before"):
            correct_file(path, model, tmp_path / "out.csv")
        return
    if name in CONTRADICTORY:  # of whole files that contradict the chain, the cause is said
        cause = UNITS.get(name, "its states are unlike the training, and the kinematics put")
        with pytest.raises(EstimatorError, match=cause):
            correct_file(path, model, tmp_path / "out.csv")
        if name in UNITS:
            return
        columns = {n: np.r_[v, TODAY.states[:, k], TODAY.states[:, k]]
                   for k, (n, v) in enumerate(columns.items())}  # fmt: skip
        runs = {"run": np.repeat(["wrong", "one", "two"], len(times)), "t_s": np.tile(times, 3)}
        parquet.write_table(pa.table({**runs, **columns}), path)
    correct_file(path, model, tmp_path / "out.csv")
    rows = Table.read(tmp_path / "out.csv").labels("status")
    assert rows[: len(said)] == said
    assert set(rows[len(said) :]) <= {"corrected"}


def _word(answer: Correction) -> str:
    return "unfamiliar" if answer.unfamiliar else "corrected"


def test_healthy_states_are_not_flagged(model_path: Path) -> None:
    model = OnnxModel.load(model_path)
    for states, times in ((TODAY.states, TODAY.times_s), (KNOWN.states[:ROWS], KNOWN.times_s)):
        guarded = GuardedModel(model.another())
        said = [guarded.update(s, t) for s, t in zip(states, times, strict=False)]
        assert np.mean([isinstance(a, Refusal) or a.unfamiliar for a in said]) < 0.005


@pytest.mark.parametrize("chain", [True, False])
@pytest.mark.parametrize("column", range(9))
@pytest.mark.parametrize("factor", [-1.0, 1e3, 1e-3, 180 / np.pi, np.pi / 180, 1e20])
def test_no_correction_leaves_the_training_with_a_small_stated_error(
    chain: bool, column: int, factor: float, models: dict[bool, OnnxModel]
) -> None:
    """By the file alone, as any runtime runs it: each input in another unit or of another sign."""
    model = models[chain]
    data = replace(TODAY, schema=model.schema, states=scaled([column], factor)(TODAY.states))
    estimates = model.predict(data)
    assert np.isfinite(estimates.covariances).all()
    length = np.linalg.norm(estimates.errors_mm, axis=1)
    assert length.max() <= 1.001 * model.facts["largest_mm"]
    low, high = np.array(model.facts["range"])[column]
    half = (high - low) / 2
    outside = np.abs(data.states[:, column] - (high + low) / 2) > 4 * max(half, 0.01)
    sd = np.sqrt(np.trace(estimates.covariances[outside], axis1=1, axis2=2))
    known = np.linalg.norm(data.errors_mm, axis=1)[outside]
    assert (estimates.strangeness[outside] > 1).all()
    if outside.any():
        assert np.sqrt((sd**2).mean()) > 0.8 * np.sqrt((known**2).mean())


@pytest.fixture(scope="module")
def models() -> dict[bool, OnnxModel]:
    return {chain: fitted(chain).model for chain in (True, False)}  # type: ignore[attr-defined]


def test_a_state_that_contradicts_itself_leaves_no_trace(model_path: Path) -> None:
    """Nor does one of no numbers, by the file alone."""
    clean, disturbed = OnnxModel.load(model_path), OnnxModel.load(model_path)
    for row in range(40):
        wanted = clean.update(TODAY.states[row], float(TODAY.times_s[row]))
        got = disturbed.update(TODAY.states[row], float(TODAY.times_s[row]))
        np.testing.assert_array_equal(got.error_mm, wanted.error_mm)
        for odd in (TODAY.states[row] * -1.0, np.full(9, np.nan), np.full(9, 1e30)):
            answer = disturbed.update(odd, float(TODAY.times_s[row]) + 0.01)
            assert answer.contradictory
            assert not answer.error_mm.any()
    assert clean.facts["gap_mm"] < 0.1


def test_a_model_in_a_program(model_path: Path) -> None:
    """What comes back is a trajectory's, and says which states are none."""
    model = measure_learning.load(model_path)
    states, times = TODAY.states.copy(), TODAY.times_s
    states[70, 4] *= -1.0
    found = model.correct(states, times)
    error, covariance = found
    known = OnnxModel.load(model_path)
    for row in range(69):
        one = known.update(states[row], float(times[row]))
        np.testing.assert_allclose(error[row], one.error_mm, atol=1e-5)
        np.testing.assert_allclose(covariance[row], one.covariance, rtol=1e-4)
    assert np.flatnonzero(found.contradictory).tolist() == [70]
    assert np.flatnonzero(found.unfamiliar).tolist() == [70]
    assert not error[70].any()
    assert covariance.shape == (ROWS, 3, 3)
    assert len(model.correct(np.empty((0, 9))).error) == 0
    with pytest.raises(ValueError, match="states"):
        model.correct(states[:, :8])
    heavy = "import sys, measure_learning; print({'numpy', 'onnxruntime'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert run.stdout == "set()\n"
