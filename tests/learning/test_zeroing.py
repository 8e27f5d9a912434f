"""What a restart leaves is found on a short stretch, and drift is told from calm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure_learning.core import DriftMonitor, Split, fit_zeroing
from measure_learning.robots import find_schema


def test_rezero_finds_joints_homed_otherwise(split: Split) -> None:
    """Found on one stretch, the zeros hold on another, where the tip is off otherwise."""
    schema, rng = split.train.schema, np.random.default_rng(1)
    zeros = np.array([1e-3, -1e-3, 0.1, 0.02, -0.03, 0.02])

    def offsets(states: Floats) -> Floats:
        q = schema.joint_positions(states)
        return schema.chain.tip_mm(q + zeros) - schema.chain.tip_mm(q)

    states, later = split.train.states[:200], split.test.states
    noisy = offsets(states) + rng.normal(0.0, 0.2, (200, 3))
    noisy[::40] += 20.0  # false detections
    zeroing = fit_zeroing(schema, states, noisy)
    before = np.linalg.norm(offsets(later), axis=1).mean()
    left = np.linalg.norm(offsets(later) - zeroing.offset_mm(later), axis=1).mean()
    constant = np.linalg.norm(offsets(later) - zeroing.mean_mm, axis=1).mean()
    assert before > 0.5
    assert left < 0.25 * before
    assert constant > 1.5 * left
    assert 0.0 < zeroing.sd_mm < 0.3
    assert zeroing.offset_mm(later[3]) == pytest.approx(zeroing.offset_mm(later)[3])
    with pytest.raises(EstimatorError, match="at least 10 measured states, got 5"):
        fit_zeroing(schema, states[:5], noisy[:5])


def test_rezero_without_kinematics_finds_the_offset(split: Split) -> None:
    schema = replace(split.train.schema, chain=None, joints=())
    rng, true = np.random.default_rng(1), np.array([0.8, -0.5, 0.2])
    states = split.train.states[:60]
    zeroing = fit_zeroing(schema, states, true + rng.normal(0, 0.3, (60, 3)))
    assert np.linalg.norm(zeroing.offset_mm(states[0]) - true) < 3 * zeroing.sd_mm
    assert zeroing.sd_mm < 0.3


def test_rezero_that_would_harm_is_refused(split: Split) -> None:
    """Alike errors of one place, poses at one place, and halves that contradict each other."""
    schema, rng = split.train.schema, np.random.default_rng(1)
    states = split.train.states
    order = rng.permutation(len(states))[:200]
    wandering = np.cumsum(rng.normal(0, 0.2, (200, 3)), axis=0)
    with pytest.raises(EstimatorError, match=r"tell as much of the zeros as .* independent ones"):
        fit_zeroing(schema, states[order], wandering)
    noise = rng.normal(0, 0.3, (200, 3))
    spread_sd = schema.joint_positions(states).std(axis=0)
    assert fit_zeroing(schema, states[order], 0.8 + noise, spread_sd=spread_sd).sd_mm < 0.3
    with pytest.raises(EstimatorError, match=r"spread over 0% .* ten poses or more, spread over"):
        fit_zeroing(schema, states[np.full(200, 7)], 0.8 + noise, spread_sd=spread_sd)
    turned = np.where(np.arange(200)[:, None] < 100, 0.8, -0.8) + 3.0 * noise
    turned -= turned.mean(axis=0)
    with pytest.raises(EstimatorError, match=r"would do harm: .* leave .* mm RMS, none leave"):
        fit_zeroing(schema, states[order], turned + np.where(np.arange(200) % 2, 1, -1)[:, None])


def test_drift_is_seen_and_calm_is_not_drift() -> None:
    rng = np.random.default_rng(2)
    covariance = np.diag([0.1, 0.2, 0.05])
    root = np.sqrt(covariance)
    calm = DriftMonitor()
    for _ in range(3000):
        calm.add(root @ rng.normal(size=3), covariance)
        assert not calm.due
    for _ in range(1000):
        calm.add(1.8 * root @ rng.normal(size=3), covariance)
    assert calm.due
    assert "train again" in calm.sentence()
    assert "too few" in DriftMonitor().sentence()


def test_rezero_gives_no_zero_to_a_joint_that_moves_no_tip() -> None:
    """With a straight wrist its roll stays as it is, and poses far apart need no wide spread."""
    schema, rng = find_schema("dvrk-psm"), np.random.default_rng(0)
    q = np.zeros((20, 6))
    q[:, 2] = 120.0
    q[:, :2] += rng.normal(0.0, 0.2, (20, 2))
    q[:, 4:] += rng.normal(0.0, 0.002, (20, 2))

    def states(joints: Floats) -> Floats:
        return np.concatenate([joints * [1, 1, 1e-3, 1, 1, 1], schema.chain.tip_mm(joints)], axis=1)

    usual = np.array([0.4, 0.4, 20.0, 0.6, 0.6, 0.6])
    wide = rng.normal(0.0, 1.0, (200, 6)) * usual + [0, 0, 120.0, 0, 0, 0]
    residuals = np.array([0.8, -0.5, 0.2]) + rng.normal(0.0, 0.3, (20, 3))
    zeroing = fit_zeroing(schema, states(q), residuals, spread_sd=usual)
    assert abs(zeroing.joints()[0][3]) < np.deg2rad(3.0)
    elsewhere = np.linalg.norm(zeroing.offset_mm(states(wide)), axis=1)
    assert elsewhere.max() < 2.5
    in_a_row = np.repeat(np.arange(20), 4)
    with pytest.raises(EstimatorError, match=r"spread over .*, 50% are needed"):
        fit_zeroing(schema, states(q[in_a_row]), residuals[in_a_row], spread_sd=usual)
