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
from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import EstimateClient, EstimateServer, Refusal, correct_file
from measure_learning.onnx import OnnxEstimator, OnnxModel
from measure_learning.robots import find_schema
from measure_learning.robots.tables import Table
from tests.learning.conftest import serving

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")

ROWS, MIDDLE = 150, np.array([0.1, -0.2, 0.14, 0.5, 0.3, -0.4])
SPANS, MM = np.array([0.5, 0.4, 0.05, 1.2, 0.9, 0.9]), np.array([1, 1, 1e3, 1, 1, 1])


def walks(names: list[str], seed: int) -> Dataset:
    """A dVRK arm whose joints err by an offset and a lag, in smooth motion."""
    rng, schema = np.random.default_rng(seed), find_schema("dvrk-psm")
    phases, rates = rng.uniform(0, 6, (len(names), 1, 6)), rng.uniform(0.5, 1.5, (len(names), 1, 6))
    times = 0.1 * np.arange(ROWS)
    q = (MIDDLE + SPANS * np.sin(phases + rates * times[None, :, None])).reshape(-1, 6)
    off = 0.02 * SPANS * MM * (1.0 + np.sign(np.gradient(q, axis=0)))
    tips = schema.chain.tip_mm(q * MM)
    errors = schema.chain.tip_mm(q * MM + off) - tips + rng.normal(0, 0.05, tips.shape)
    return Dataset(
        schema, np.hstack([q, tips]), np.tile(times, len(names)),
        np.repeat(np.arange(len(names)), ROWS), tuple(names), errors,
        np.tile(0.01 * np.eye(3), (len(q), 1, 1)), np.ones(len(q), dtype=bool),
    )  # fmt: skip


KNOWN, TODAY = walks([f"day{k}" for k in range(4)], 1), walks(["today"], 2)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, OnnxModel]:
    """With the robot's chain known, and without."""
    found = {}
    for chain in (True, False):
        fit = Registry.discover().build(Estimator, "ridge", {"play_widths": 3})
        assert isinstance(fit, OnnxEstimator)
        fit.folds, path = 2, tmp_path_factory.mktemp("model") / "ridge.onnx"
        known = KNOWN.schema
        data = replace(KNOWN, schema=known if chain else replace(known, chain=None))
        fit.fit(data.select(data.names[:3]), data.select(data.names[3:]), seed=0, report=quiet)
        fit.save(path, {})
        found[chain] = measure_learning.load(path)
    return found


def scaled(columns: list[int], factor: float) -> Callable[[Floats], Floats]:
    factors = np.ones(9)
    factors[columns] = factor
    return lambda states: states * factors


def elsewhere(states: Floats) -> Floats:
    """An arm that reaches where it never was, and reports so."""
    q = states[:, :6] + [1.5, 1.2, 0.1, 0, 0, 0]
    return np.hstack([q, KNOWN.schema.chain.tip_mm(q * MM)])


KINEMATICS = "unlike the training, and the kinematics put"
SHUFFLED = np.random.default_rng(3).permutation(ROWS)
CASES: dict[str, tuple[Callable[[Floats], Floats], str, str]] = {
    "joint negated": (scaled([4], -1.0), Refusal.CONTRADICTORY, KINEMATICS),
    "joint turned": (lambda s: s + np.pi / 2 * np.eye(9)[3], Refusal.CONTRADICTORY, KINEMATICS),
    "joints exchanged": (
        lambda s: s[:, [0, 1, 2, 3, 5, 4, 6, 7, 8]], Refusal.CONTRADICTORY, KINEMATICS),
    "insertion in mm": (scaled([2], 1e3), Refusal.CONTRADICTORY, "is its column in mm"),
    "in degrees": (scaled([0, 1, 3, 4, 5], 180 / np.pi), Refusal.CONTRADICTORY, "in deg"),
    "tip in m": (scaled([6, 7, 8], 1e-3), Refusal.CONTRADICTORY, KINEMATICS),
    "axes exchanged": (
        lambda s: s[:, [0, 1, 2, 3, 4, 5, 7, 6, 8]], Refusal.CONTRADICTORY, KINEMATICS),
    "axis negated": (scaled([8], -1.0), Refusal.CONTRADICTORY, KINEMATICS),
    "rows of the joints shuffled": (
        lambda s: np.hstack([s[SHUFFLED, :6], s[:, 6:]]), Refusal.CONTRADICTORY, KINEMATICS),
    "rows shuffled": (lambda s: s[SHUFFLED], Refusal.STALE, "stamps are not after the one before"),
    "no number": (lambda s: s + np.nan * np.eye(9)[4], Refusal.NOT_A_NUMBER, ""),
    "where it never was": (elsewhere, "unfamiliar", ""),
    "healthy": (lambda s: s, "corrected", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_input_has_its_status_by_udp_and_in_a_file(
    name: str, models: dict[bool, OnnxModel], tmp_path: Path
) -> None:
    change, wanted, words = CASES[name]
    model, states, times = models[True], change(TODAY.states), TODAY.times_s
    times = times[SHUFFLED] if name == "rows shuffled" else times
    with serving(EstimateServer(model.another(), ("127.0.0.1", 0))) as server:
        client = EstimateClient(server.address, timeout_s=20.0)
        answers = [client.ask(s, t).answer for s, t in zip(states, times, strict=True)]
        client.close()
    said = [str(a) if isinstance(a, Refusal) else ("corrected", "unfamiliar")[a.unfamiliar]
            for a in answers]  # fmt: skip
    apart = model.schema.chain.tip_mm(states[:, :6] * MM) - states[:, 6:]
    clear = np.linalg.norm(apart, axis=1) > 1.0 if words == KINEMATICS else np.full(ROWS, True)
    assert clear.mean() > 0.9
    assert np.mean(np.array(said)[clear] == wanted) > (0.4 if wanted is Refusal.STALE else 0.999)
    path, out = tmp_path / "states.parquet", tmp_path / "out.csv"

    def write(parts: list[Floats], stamps: Floats) -> None:
        columns = dict(zip(model.features, np.concatenate(parts).T, strict=True))
        runs = {"run": np.repeat(["first", "one", "two"][: len(parts)], ROWS), "t_s": stamps}
        parquet.write_table(pa.table({**runs, **columns}), path)

    write([states], times)
    if words:
        with pytest.raises(EstimatorError, match=words):
            correct_file(path, model.another(), out)
    if words in ("", KINEMATICS):  # few of many are no reason to refuse a file
        write([states, TODAY.states, TODAY.states], np.r_[times, TODAY.times_s, TODAY.times_s])
        correct_file(path, model.another(), out)
        rows = Table.read(out).labels("status")
        assert rows[:ROWS] == said
        assert set(rows[ROWS:]) == {"corrected"}


@pytest.mark.parametrize("chain", [True, False])
@pytest.mark.parametrize("factor", [-1.0, 1e3, 1e-3, 180 / np.pi, np.pi / 180, 1e20])
def test_no_correction_leaves_the_training_with_a_small_stated_error(
    chain: bool, factor: float, models: dict[bool, OnnxModel]
) -> None:
    """By the file alone, as any runtime runs it: each input in another unit or of another sign."""
    model = models[chain]
    for column in range(9):
        found = model.correct(scaled([column], factor)(TODAY.states), TODAY.times_s)
        assert np.isfinite(found.covariance).all()
        lengths = np.linalg.norm(found.error, axis=1)
        assert lengths.max() <= 1.001 * model.facts["largest_mm"]
        low, high = np.array(model.facts["range"])[column]
        off = np.abs(factor * TODAY.states[:, column] - (high + low) / 2)
        outside = off > 4 * max((high - low) / 2, 0.01)
        assert found.unfamiliar[outside].all()
        sd2 = np.trace(found.covariance, axis1=1, axis2=2)[outside]
        known2 = (TODAY.errors_mm**2).sum(axis=1)[outside]
        assert sd2.sum() >= 0.64 * known2.sum()


def test_a_state_that_contradicts_itself_leaves_no_trace(models: dict[bool, OnnxModel]) -> None:
    """Nor does one of no numbers; what comes back says so, and importing costs nothing."""
    model = models[True]
    odd = np.stack([TODAY.states[70] * -1.0, np.full(9, np.nan), np.full(9, 1e30)])
    states = np.insert(TODAY.states, [70, 70, 70], odd, axis=0)
    found = model.correct(states, np.insert(TODAY.times_s, 70, 7.0 - np.array([0.09, 0.06, 0.03])))
    assert np.flatnonzero(found.contradictory).tolist() == [70, 71, 72]
    assert np.flatnonzero(found.unfamiliar).tolist() == [70, 71, 72]
    assert not found.error[70:73].any()
    error, covariance = model.correct(TODAY.states, TODAY.times_s)
    np.testing.assert_allclose(np.delete(found.error, [70, 71, 72], axis=0), error, atol=1e-5)
    assert covariance.shape == (ROWS, 3, 3)
    assert len(model.correct(np.empty((0, 9))).error) == 0
    heavy = "import sys, measure_learning; print({'numpy', 'onnxruntime'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert run.stdout == "set()\n"
