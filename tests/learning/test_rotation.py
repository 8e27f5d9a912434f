"""The rotation of the tip as a label: its convention, what is learnt of it, and what is not."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import recorded, ur5e
from measure.cli import main
from measure.geometry import RigidTransform
from measure.host import Estimator, Registry, quiet
from measure.robots import RobotLog
from measure_learning import core
from measure_learning.core import AnswerPacket, LabelKind, Split, StatePacket, files
from measure_learning.core.frames import RobotFrame
from measure_learning.onnx import OnnxModel
from measure_learning.onnx.rotation import turn_errors
from measure_learning.robots import write_log
from measure_learning.robots.tables import Table

TILTED = RigidTransform.from_rotvec([np.pi / 2, 0, 0], [40.0, -20.0, 60.0])  # a body on its flange
TURN, VARIANCES = np.array([0.03, -0.02, 0.05]), np.array([1e-4, 1e-8, 1e-8])  # these in the world


def test_a_turn_is_in_the_base_and_follows_the_reported_rotation(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A tip that is turned by `TURN`; where the body stands on it unknown, there are no labels."""
    arm = recorded(2, seconds=20.0, frame_hz=5.0, true=ur5e(), flange_from_body=TILTED)
    base, settings = arm.world_from_base, core.AssemblySettings(arm.clock_offset_s)
    tip = base.inverse() @ arm.track.table().world_from_body @ TILTED.inverse()
    seen = base @ tip.perturb([0, 0, 0, *TURN]) @ TILTED
    P = np.tile(np.diag([0.01, 0.01, 0.01, *VARIANCES]), (len(tip.translation), 1, 1))
    poses = {"positions_mm": seen.translation, "rotations": seen.rotation, "pose_covariances": P}
    track = replace(arm.track, **poses)
    frame = RobotFrame("ur5e-test", base, TILTED, {}, np.zeros((12, 12)), (), {})
    data, _ = core.assemble([(frame.to_base(track), arm.log)], settings)
    turns = data.turns
    np.testing.assert_allclose(turns.vectors_rad.mean(axis=0), TURN, atol=1e-3)
    reported = ur5e().pose(data.joints).rotation
    corrected = RigidTransform.from_rotvec(turns.vectors_rad).rotation @ reported
    np.testing.assert_allclose(base.rotation @ corrected @ TILTED.rotation, seen.rotation)
    in_world = base.rotation @ turns.covariances @ base.rotation.T
    np.testing.assert_allclose(in_world, P[:, 3:, 3:], atol=1e-11)
    files.write_dataset(tmp_path / "a.parquet", data, [], "a test")
    again, plain = (
        files.read_dataset(tmp_path / "a.parquet"),
        replace(data, turns=None, names=("b",)),
    )
    assert again.digest() == data.digest() != plain.digest()
    known = core.join([plain, again]).turns.known
    np.testing.assert_array_equal(known, np.arange(2 * len(data)) >= len(data))
    lever = RigidTransform(np.eye(3), TILTED.rotation.T @ TILTED.translation)
    straight = replace(frame, flange_from_body=lever)
    assert core.assemble([(straight.to_base(track), arm.log)], settings)[0].turns is None
    assert "a body turned by 9" in caplog.text


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Split, Path]:
    """Simulated sessions whose labels hold rotations; two other restarts, judged by the truth."""
    data, test = (
        core.simulated_dataset(
            minutes=count, pairs=300 * count, restarts=count, seed=seed,
            labels=LabelKind(exact, rotations=True), settings=core.AssemblySettings(cut_s=30.0),
        )[0]
        for count, seed, exact in ((5, 4, False), (2, 9, True))
    )  # fmt: skip
    *_, last = data.recordings().values()
    first = data.select([name for name in data.present() if name not in last])
    parts = Split(first, data.select(last), test)
    folder = tmp_path_factory.mktemp("rotation")
    words = ["train", str(folder / "train.parquet"), "--out", str(folder / "m.onnx")]
    for name, part in vars(parts).items():
        files.write_dataset(folder / f"{name}.parquet", part, [], "simulated")
        words += [] if name == "train" else [f"--{name}", str(folder / f"{name}.parquet")]
    assert main([*words, "--estimator", "ridge", "--set", "play_widths=3"]) == 0
    return parts, folder / "m.onnx"


def test_rotations_of_restarts_never_seen_are_corrected(trained: tuple[Split, Path]) -> None:
    """Positions are corrected as they are without; noise is left alone, and nothing invented."""
    parts, model = trained
    estimates = OnnxModel.load(model).predict(parts.test)
    score = core.evaluate(parts.test, estimates).turn
    assert score.rows == parts.test.usable.sum()
    assert score.before_deg > 12
    assert score.after_deg < 0.5 * score.before_deg
    assert score.inside_95 > 0.7
    card = model.with_suffix(".card.md").read_text()
    assert f"{score.before_deg:.3f} deg RMS as reported, {score.after_deg:.3f} corrected" in card
    assert "- rotation of the tip, 4 groups of recordings left out: " in card
    assert "rotation of the tip" in model.with_suffix(".report.html").read_text()
    rng = np.random.default_rng(0)
    for said in ([], ["it is not corrected"]):
        other = []
        for name in vars(parts):
            part = files.read_dataset(model.with_name(f"{name}.parquet"))
            noise = replace(part.turns, vectors_rad=rng.normal(0, 0.02, (len(part), 3)))
            other.append(replace(part, turns=noise if said else None))
        fit = Registry.discover().build(Estimator, "ridge", {"play_widths": 3})
        fit.fit(other[0], other[1], seed=0, report=quiet)
        assert [line.rpartition(": ")[2] for line in fit.findings] == said
        plain = fit.model.predict(other[2])
        assert plain.turns is None
        np.testing.assert_array_equal(plain.errors_mm, estimates.errors_mm)
        np.testing.assert_array_equal(plain.covariances, estimates.covariances)


def test_every_way_to_it_says_the_same(trained: tuple[Split, Path], tmp_path: Path) -> None:
    """Batch, server, `measure estimate` and onnxruntime alone, bit for bit."""
    parts, model = trained
    test = parts.test.select(parts.test.present()[:1])
    loaded = OnnxModel.load(model)
    wanted = loaded.predict(test).turns
    alone = runpy.run_path("docs/examples/onnx/correct.py")["Corrector"](model)
    server = core.EstimateServer(loaded, ("127.0.0.1", 0))
    for row, (state, time_s) in enumerate(zip(test.states, test.times_s, strict=True)):
        error_mm, _, _, turn_rad, turn_covariance = alone.correct(state, time_s)
        np.testing.assert_array_equal(turn_rad, wanted.vectors_rad[row])
        np.testing.assert_array_equal(turn_covariance, wanted.covariances[row].ravel())
        for turn, size in ((False, 57), (True, 93)):  # bytes, of positions as ever
            packed = server.answer(StatePacket(row, time_s, state, turn).pack(), ("", 7 + turn))
            answer = AnswerPacket.unpack(packed).answer
            assert len(packed) == size
            np.testing.assert_array_equal(answer.error_mm, error_mm)
            assert (answer.turn.vectors_rad == turn_rad).all() if turn else answer.turn is None
    server.close()
    log, out = tmp_path / "log.parquet", tmp_path / "out.parquet"
    write_log(log, RobotLog(test.schema, test.times_s, test.states))
    assert main(["estimate", str(model), "--input", str(log), "--out", str(out)]) == 0
    table = Table.read(out)
    turns = table.numbers("turn_x_rad", "turn_y_rad", "turn_z_rad", "turn_cov_yz_rad2")
    np.testing.assert_array_equal(turns[:, :3], wanted.vectors_rad)
    np.testing.assert_array_equal(turns[:, 3], wanted.covariances[:, 1, 2])
    corrected = RigidTransform.from_quat_wxyz(table.numbers("qw", "qx", "qy", "qz"), np.zeros(3))
    reported = test.schema.chain.pose(test.joints).rotation
    np.testing.assert_allclose(turn_errors(corrected.rotation, reported), turns[:, :3], atol=1e-6)
