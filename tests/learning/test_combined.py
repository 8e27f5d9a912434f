"""An estimator that learns what another leaves: two plugins, one model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.registration import ur5e
from benchmarks.stiff_arm import recording
from measure.cli import main
from measure.errors import EstimatorError, PluginError
from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import EstimateServer, StatePacket, TruePacket, evaluate, files, join
from measure_learning.core.server import AnswerPacket
from measure_learning.onnx import OnnxEstimator, OnnxModel
from tests.strangers import Install

FEW = {"play_widths": 2}
STRANGER = """
from measure.host import Estimator, hookimpl

class Own(Estimator):
    "An estimator with a file of its own kind."
    name = "own"

    def fit(self, data, validation, *, seed, report): ...
    def save(self, path, card): ...
    def reset(self): ...
    def update(self, state, time_s): ...

@hookimpl
def measure_estimators():
    return [Own]
"""


@pytest.fixture(scope="module")
def days() -> list[Dataset]:
    """Six recordings of one stiff arm with wrong links and play."""
    true = ur5e(mm=0.5, deg=0.05, seed=4)
    return [recording(seed, true, seconds=20.0, noise=0.05) for seed in range(6)]


def fitted(estimator: OnnxEstimator, days: list[Dataset], folds: int = 0) -> OnnxEstimator:
    estimator.folds = folds
    estimator.fit(join(days[:4]), days[4], seed=0, report=quiet)
    return estimator


def build(name: str, settings: dict[str, Any] = FEW) -> OnnxEstimator:
    estimator = Registry.discover().build(Estimator, name, {} if name == "kinematic" else settings)
    assert isinstance(estimator, OnnxEstimator)
    return estimator


@pytest.mark.parametrize("first", ["kinematic", "ridge"])
def test_it_is_the_first_and_what_the_second_learns_of_the_rest(
    days: list[Dataset], first: str
) -> None:
    """With and without a memory of the first."""
    window = {"features": "window", "window": 3}
    alone = fitted(build(first, window), days).model
    rest = [replace(d, errors_mm=d.errors_mm - alone.predict(d).errors_mm) for d in days]
    second = fitted(build("ridge"), rest).model
    both = fitted(build("ridge").after(build(first, window)), days).model
    found, expected = both.predict(days[5]), alone.predict(days[5])
    added = expected.errors_mm + second.predict(days[5]).errors_mm
    np.testing.assert_allclose(found.errors_mm, added, atol=2e-4)
    assert np.abs(found.errors_mm - expected.errors_mm).max() > 0.1


def test_play_is_learnt_after_the_links_and_the_covariance_is_of_both(days: list[Dataset]) -> None:
    left = []
    for name in ("kinematic", "ridge after kinematic"):
        estimator = fitted(build(name), days, folds=2)
        found = evaluate(days[5], estimator.model.predict(days[5]))
        left.append(found.after.rms_mm)
        assert estimator.left_out.before_mm > 1.0, "of the robot, not of what the first leaves"
        assert estimator.left_out.after_mm == pytest.approx(left[-1], rel=0.4)
        assert 0.6 < found.consistency**0.5 < 1.5
    assert left[1] < 0.7 * left[0]


def test_one_file_by_the_command_line_that_names_both(
    days: list[Dataset], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, model, out = (str(tmp_path / n) for n in ("data.parquet", "model.onnx", "out.csv"))
    files.write_dataset(Path(data), join(days), [], "a stiff arm")
    words = ["train", data, "--out", model, "--estimator", "ridge after kinematic", "--folds", "0"]
    assert main([*words, "--set", "features=pose"]) == 0
    card = (tmp_path / "model.card.md").read_text()
    assert "# ridge after kinematic for ur5e-test" in card
    assert "link3_z_deg" in card
    assert main(["estimate", model, "--input", data, "--out", out]) == 0
    states, loaded = join(days), OnnxModel.load(Path(model))
    expected = loaded.predict(states).errors_mm
    found = np.loadtxt(out, delimiter=",", skiprows=1, usecols=(3, 4, 5))
    np.testing.assert_allclose(found, expected, atol=1e-4)
    # Online, with a true position, whose offset it follows.
    server, me = EstimateServer(loaded, ("127.0.0.1", 0)), ("127.0.0.1", 5)
    for row in range(3):
        packet = StatePacket(row, states.times_s[row], states.states[row])
        answer = AnswerPacket.unpack(server.answer(packet.pack(), me)).answer
        assert not isinstance(answer, str)
        assert answer.error_mm == pytest.approx(expected[row], abs=1e-4)
    true = states.reported_mm[2] + expected[2] + [1.0, 0.0, 0.0]
    answer = AnswerPacket.unpack(server.answer(TruePacket(2, true, 0.01).pack(), me)).answer
    server.close()
    assert not isinstance(answer, str)
    assert answer.error_mm[0] > expected[2, 0] + 0.3
    # Homed otherwise, it finds the zeros.
    chain, today = states.schema.chain, days[5]
    q = today.schema.joint_positions(today.states)
    off = chain.tip_mm(q + np.deg2rad([0.1, -0.08, 0.1, 0.1, 0.1, 0.0])) - chain.tip_mm(q)
    path = str(tmp_path / "today.parquet")
    files.write_dataset(Path(path), replace(today, errors_mm=today.errors_mm + off), [], "today")
    left = []
    for more in ([], ["--rezero", path]):
        assert main(["estimate", model, "--input", path, "--out", out, "--overwrite", *more]) == 0
        found = np.loadtxt(out, delimiter=",", skiprows=1, usecols=(3, 4, 5))
        left.append(np.linalg.norm(today.errors_mm + off - found, axis=1).mean())
    assert left[1] < 0.5 * left[0]
    # A part that it names is fitted again where one asks what its inputs are worth.
    capsys.readouterr()
    assert main(["ablate", data, model, "--remove", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)


def test_what_cannot_be_combined_is_refused_by_name(days: list[Dataset], install: Install) -> None:
    bare = [replace(d, schema=replace(d.schema, chain=None, joints=())) for d in days]
    with pytest.raises(EstimatorError, match="'kinematic' needs the robot's kinematics"):
        fitted(build("ridge after kinematic"), bare)
    install("acme-own", STRANGER)
    registry = Registry.discover()
    with pytest.raises(PluginError, match="no estimator is called 'kinematics'"):
        registry.build(Estimator, "stream after kinematics", {})
    for name in ("ridge after own", "own after ridge"):
        with pytest.raises(PluginError, match=r"'\w+' cannot learn what '\w+' leaves"):
            registry.build(Estimator, name, {})
