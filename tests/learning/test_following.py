"""True positions that come now and then correct what follows them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.host import Correction, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import EstimateServer, OffsetFollower, Refusal, Split, TruePacket
from measure_learning.core.server import AnswerPacket, StatePacket
from measure_learning.onnx import OnnxModel
from measure_learning.robots import find_schema
from measure_learning.robots.tables import Table

ME = ("127.0.0.1", 5)


@pytest.fixture(scope="module")
def model_path(split: Split, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "offset.onnx"
    estimator = Registry.discover().build(Estimator, "offset", {})
    estimator.fit(split.train, split.validation, seed=0, report=quiet)
    estimator.save(path, {})
    return path


def test_joint_offsets_are_followed_to_other_poses() -> None:
    """A joint homed otherwise moves the tip otherwise elsewhere; every tenth position is true."""
    schema, rng = find_schema("dvrk-psm"), np.random.default_rng(3)
    q = np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0]) + np.cumsum(
        rng.normal(0, [0.03, 0.03, 1.0, 0.1, 0.1, 0.1], (400, 6)), axis=0
    )
    q = np.clip(q, [-0.6, -0.6, 110, -1, -1, -1], [0.6, 0.6, 190, 1, 1, 1])
    tips = schema.chain.tip_mm(q)
    states = np.concatenate([q * [1, 1, 1e-3, 1, 1, 1], tips], axis=1)
    zeros = np.array([0.004, -0.003, 0.4, 0.03, -0.03, 0.02])
    errors = schema.chain.tip_mm(q + zeros) - tips + rng.normal(0, 0.2, tips.shape)
    follower, nothing = OffsetFollower(schema), Correction(np.zeros(3), 0.04 * np.eye(3))
    left, stated = [], []
    for row in range(400):
        answer = follower.corrected(nothing, states[row], 0.4 * row)
        if row % 10 == 0:
            true_mm = tips[row] + errors[row]
            follower.add(nothing, states[row], 0.4 * row, true_mm, 1e-4 * np.eye(3))
        elif row > 50:
            left.append((errors[row], errors[row] - answer.error_mm))
            stated.append(np.trace(answer.covariance))
    before, after = np.sqrt((np.array(left) ** 2).sum(axis=2).mean(axis=0))
    assert after < 0.6 * before
    assert not follower.monitor.due
    assert 0.8 < np.sqrt(np.mean(stated)) / after < 1.25
    rest = follower.corrected(nothing, states[399], 1e4)
    assert np.linalg.norm(rest.error_mm) > 0.3  # an arm at rest forgets nothing
    far = states[399] + [0.5, 0.5, 0, 0, 0, 0, 0, 0, 0]
    for row in range(40):  # hysteresis is forgotten in motion
        faded = follower.corrected(nothing, (states[399], far)[row % 2], 1e4 + row)
    assert faded.error_mm == pytest.approx(np.zeros(3), abs=1e-6)
    assert np.trace(faded.covariance) > 1.5 * np.trace(rest.covariance)
    for row in range(400):
        jump = np.array([5.0, 0, 0]) * (-1) ** row
        follower.add(nothing, states[row], 2e4 + row, tips[row] + jump, 1e-4 * np.eye(3))
    assert "train again" in follower.monitor.sentence()


def test_true_positions_by_udp(model_path: Path, split: Split) -> None:
    """They belong to a state of their own sender."""
    server = EstimateServer(OnnxModel.load(model_path), ("127.0.0.1", 0))
    state, reported = split.test.states[0], split.test.reported_mm[0]

    def ask(packet: StatePacket | TruePacket, sender: tuple[str, int] = ME) -> AnswerPacket:
        return AnswerPacket.unpack(server.answer(packet.pack(), sender))

    first = ask(StatePacket(0, 0.0, state)).answer
    true = TruePacket(0, reported + first.error_mm + [1.0, 0.0, 0.0], 0.01)
    assert ask(true, ("127.0.0.1", 6)).answer is Refusal.REPEATED
    assert ask(TruePacket(7, true.position_mm, 0.01)).answer is Refusal.REPEATED
    assert ask(StatePacket(1, 0.01, state)).answer.error_mm == pytest.approx(first.error_mm)  # type: ignore[union-attr]
    seen = ask(true).answer
    later = ask(StatePacket(2, 0.02, state)).answer
    assert 0.1 < later.error_mm[0] - first.error_mm[0] < 1.0
    assert later.error_mm == pytest.approx(seen.error_mm, abs=1e-3)
    assert ask(TruePacket(0, np.full(3, np.nan), 0.01)).answer is Refusal.MALFORMED
    in_metres = TruePacket(2, true.position_mm / 1000, 0.01)
    assert ask(in_metres).answer is Refusal.FAR
    assert ask(StatePacket(3, 0.03, state)).answer.error_mm == pytest.approx(
        later.error_mm, abs=1e-3
    )  # type: ignore[union-attr]
    assert server.counters.measured == 1
    assert "drift" in (server.drift() or "")
    again = ask(StatePacket(0, 0.0, state)).answer  # the robot's program was started again
    assert again.error_mm == pytest.approx(first.error_mm, abs=1e-5)
    server.close()


def test_a_table_of_true_positions(
    model_path: Path, split: Split, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = split.test.select(split.test.present()[:1])
    states, poses = tmp_path / "states.csv", tmp_path / "poses.csv"
    table = np.column_stack([data.times_s, data.states])
    head = ",".join(["time_s", *data.schema.names])
    np.savetxt(states, table, delimiter=",", header=head, comments="", fmt="%.9g")
    true = (data.reported_mm + data.errors_mm)[::10]
    rows = np.column_stack([data.times_s[::10], true])
    np.savetxt(poses, rows, delimiter=",", header="time_s,x_mm,y_mm,z_mm", comments="", fmt="%.9g")
    left = []
    for name, more in (("plain", []), ("followed", ["--true-positions", str(poses)])):
        out = tmp_path / f"{name}.csv"
        words = ["estimate", str(model_path), "--input", str(states), "--out", str(out)]
        assert main([*words, *more]) == 0
        errors = Table.read(out).numbers("ex", "ey", "ez")
        kept = data.usable & (np.arange(len(data)) % 10 != 0)
        left.append(np.sqrt((((data.errors_mm - errors)[kept]) ** 2).sum(axis=1).mean()))
    assert left[1] < 0.9 * left[0]
    assert "drift" in capsys.readouterr().err
    assert main(["estimate", str(model_path), "--true-positions", str(poses)]) == 2
    assert "--true-positions needs --input" in capsys.readouterr().err
