"""The stated SD of a corrected tip holds what registering leaves open of base and tool."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import recorded, schema, ur5e
from measure.cli import main
from measure.host import Estimator, Registry
from measure_learning.core import assemble, evaluate, split_by_trajectory
from measure_learning.core.assemble import AssemblySettings
from measure_learning.core.frames import RobotFrame, write_frame
from measure_learning.core.registration import LoggedTrack, RegisterOptions, register
from measure_learning.robots.tables import Table


@pytest.fixture(scope="module")
def frame() -> RobotFrame:
    arm = recorded(2, seconds=30.0, frame_hz=5.0, true=ur5e())
    return register([LoggedTrack(arm.track, arm.log)], RegisterOptions())


def test_what_is_stated_is_the_scatter_of_the_labels(frame: RobotFrame) -> None:
    """Frames drawn from the stated covariance put and turn the tip as far apart as is said."""
    arm, rng = recorded(2, seconds=30.0, frame_hz=5.0, true=ur5e()), np.random.default_rng(0)
    track = replace(arm.track, times_s=arm.track.times_s + arm.clock_offset_s)
    at = np.array([10, 80])
    joints = np.stack([np.interp(track.times_s[at], arm.log.times_s, q) for q in arm.log.states.T])
    stated = frame.tip_covariances(schema(ur5e()), joints.T)
    tips, turns = [], []
    for delta in rng.multivariate_normal(np.zeros(12), frame.covariance[:12, :12], 2000):
        other = replace(
            frame,
            world_from_base=frame.world_from_base.perturb(delta[:6]),
            flange_from_body=frame.flange_from_body.perturb(delta[6:]),
        )
        tip, mean = (one.to_base(track).table().world_from_body for one in (other, frame))
        tips.append(tip.translation[at])
        turns.append(tip.difference(mean)[at, 3:])
    for drawn, said in zip((tips, turns), stated, strict=True):
        for k in range(len(at)):
            scatter = np.cov(np.array(drawn)[:, k].T)
            ratios = np.linalg.eigvals(np.linalg.solve(said[k], scatter)).real
            assert np.all((ratios > 0.85) & (ratios < 1.15))


def test_estimate_states_it(
    frame: RobotFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = recorded(2, seconds=60.0, frame_hz=5.0)
    track = frame.to_base(arm.track)
    data, _ = assemble([(track, arm.log)], AssemblySettings(cut_s=6.0))
    split = split_by_trajectory(data, seed=0)
    fit = Registry.discover().build(Estimator, "ridge", {"features": "pose"})
    fit.fit(split.train, split.validation, seed=0, report=lambda *_: None)
    assert evaluate(split.test, fit.model.predict(split.test)).after.rms_mm < 1.0  # type: ignore[attr-defined]
    fit.save(tmp_path / "m.onnx", {})
    table = np.column_stack([arm.log.times_s, arm.log.states])[:200]
    head = ",".join(["time_s", *schema().names])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=head, comments="", fmt="%.9g")
    write_frame(tmp_path / "frame.toml", frame)
    write_frame(tmp_path / "other.toml", replace(frame, robot="another"))
    words = ["estimate", str(tmp_path / "m.onnx"), "--input", str(tmp_path / "log.csv"), "-o"]
    variances = []
    for name, more in (("plain", []), ("frame", ["--frame", str(tmp_path / "frame.toml")])):
        out = tmp_path / f"{name}.csv"
        assert main([*words, str(out), *more]) == 0
        variances.append(Table.read(out).numbers("cov_xx_mm2", "cov_xy_mm2", "cov_zz_mm2"))
    stated, _ = frame.tip_covariances(schema(ur5e()), arm.log.states[:200])
    more_mm2 = np.stack([stated[:, 0, 0], stated[:, 0, 1], stated[:, 2, 2]], axis=1)
    np.testing.assert_allclose(variances[1] - variances[0], more_mm2, rtol=1e-3, atol=1e-4)
    capsys.readouterr()
    assert main([*words, str(tmp_path / "o.csv"), "--frame", str(tmp_path / "other.toml")]) == 2
    assert (
        "the frame is of robot 'another', and the model of 'ur5e-test'" in capsys.readouterr().err
    )
