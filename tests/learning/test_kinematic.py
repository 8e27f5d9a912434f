"""Calibrated links of a stiff arm."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import recorded, schema, ur5e
from measure.errors import EstimatorError
from measure.host import Dataset
from measure.host.interfaces import quiet
from measure.robots import RobotLog
from measure_learning.core import assemble
from measure_learning.estimators.kinematic import KinematicEstimator, KinematicSettings
from measure_learning.onnx import OnnxModel


@pytest.fixture(scope="module")
def parts() -> list[Dataset]:
    """Three recordings of one arm that is off by 0.5 mm and 0.05 deg, measured in its base."""
    out = []
    true = ur5e(mm=0.5, deg=0.05, seed=4)
    for seed in range(3):
        arm = recorded(seed, seconds=30.0, frame_hz=8.0, true=true)
        noise = np.random.default_rng(seed).normal(0, 0.05, arm.true_tip_mm.shape)
        track = replace(arm.track, positions_mm=arm.true_tip_mm + noise)
        log = RobotLog(schema(ur5e()), arm.log.times_s - arm.clock_offset_s, arm.log.states)
        out.append(assemble([(track, log)])[0])
    return out


def test_links_are_found_and_correct_what_was_not_seen(
    parts: list[Dataset], tmp_path: Path
) -> None:
    estimator = KinematicEstimator(KinematicSettings())
    estimator.fit(parts[0], parts[1], seed=0, report=quiet)
    estimator.save(tmp_path / "model.onnx", {})
    left = parts[2].errors_mm - OnnxModel.load(tmp_path / "model.onnx").predict(parts[2]).errors_mm
    before = np.sqrt((parts[2].errors_mm ** 2).sum(axis=1).mean())
    after = np.sqrt((left[parts[2].usable] ** 2).sum(axis=1).mean())
    assert before > 0.5
    assert after < 0.15, "0.087 mm are noise"
    found = {line.split(":")[0]: line for line in estimator.findings}
    assert "not identifiable" in found["link6_z_deg"], "the tip lies on the last joint's axis"
    value, sd = map(float, re.findall(r"[+-]?\d+\.\d+", found["link3_z_deg"]))
    assert 0 < sd < 0.1
    assert abs(value) < 0.3


def test_without_known_kinematics_it_says_so(parts: list[Dataset]) -> None:
    bare = [replace(p, schema=replace(p.schema, chain=None, joints=())) for p in parts[:2]]
    with pytest.raises(EstimatorError, match=r"needs the robot's kinematics, .* alpha_deg .*urdf"):
        KinematicEstimator(KinematicSettings()).fit(*bare, seed=0, report=quiet)
