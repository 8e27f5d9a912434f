from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import ConfigError
from measure_learning.robots import raven_schema
from measure_learning.simulator import Cables, SimulatedRun, simulate

SCHEMA = raven_schema()


def _error(run: SimulatedRun) -> Floats:
    return run.world_from_tip.translation - SCHEMA.position_mm(run.states)


def test_error_has_the_papers_size() -> None:
    """The paper's 83.6 % and 59.4 % less say that 84 % of the mean square are a constant."""
    error = np.concatenate([_error(simulate(60.0, seed, log_hz=20.0)) for seed in range(1, 9)])
    square = (error**2).sum(axis=1).mean()
    assert 5.0 < np.sqrt(square) < 7.0
    assert 0.80 < 1.0 - error.var(axis=0).sum() / square < 0.88
    assert 8.0 < np.linalg.norm(error, axis=1).max() < 13.0


def test_the_same_seed_gives_the_same_run() -> None:
    first, again, other = (simulate(2.0, seed, log_hz=100.0) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.states, again.states)
    assert np.abs(first.states - other.states).max() > 1.0


NOTHING = (0.0,) * 7
STILL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
RIGID = Cables(
    stiffness=(2e4, 2e4, 9e5, 200.0, 150.0, 150.0, 150.0),
    backlash=NOTHING,
    friction=NOTHING,
    homing=NOTHING,
    restart_sd=NOTHING,
    inertia=(0.8, 0.6, 3.5, 1e-2, 6e-3, 6e-3, 6e-3),
    damping=0.7,
    registration_mm=(0.0, 0.0, 0.0),
    registration_rotvec_deg=(0.0, 0.0, 0.0),
    registration_sd=(0.0, 0.0),
)


def test_a_rigid_exact_robot_reports_the_truth() -> None:
    """Without slack, friction, coupling and static errors, and very stiff, gravity's is left."""
    error = _error(simulate(20.0, 2, log_hz=50.0, cables=replace(RIGID, wrist=STILL)))
    assert np.linalg.norm(error, axis=1).max() < 0.2


def test_the_wrist_turns_less_than_its_motors_and_its_axes_pull_each_other() -> None:
    """What is published of such a wrist, and not what the robot's software believes of it."""
    run = simulate(60.0, 3, log_hz=50.0, cables=RIGID)
    joints = SCHEMA.joint_positions(run.states)
    assert np.linalg.norm(_error(run), axis=1).max() > 2.0
    joints[:, 3:] = joints[:, 3:] @ np.array(RIGID.wrist).T
    left = run.world_from_tip.translation - SCHEMA.chain.tip_mm(joints)
    assert np.linalg.norm(left, axis=1).max() < 0.2
    mutual = RIGID.wrist[1][2] * joints[:, 5]
    assert 3.0 < np.rad2deg(np.abs(mutual).max()) < 9.0


def test_a_restart_moves_the_tip_as_on_a_real_arm() -> None:
    """Homing and the cameras' registration together, 0.7-0.8 mm; the same motion in both runs."""
    fixed = replace(Cables(), restart_sd=NOTHING, registration_sd=(0.0, 0.0))
    moved = [
        (
            _error(simulate(1.0, seed, log_hz=5.0))
            - _error(simulate(1.0, seed, cables=fixed, log_hz=5.0))
        )[-1]
        for seed in range(60)
    ]
    assert 0.6 < np.sqrt((np.array(moved) ** 2).sum(axis=1).mean()) < 0.9


def test_reported_pose_is_the_kinematics_of_the_reported_joints() -> None:
    run = simulate(5.0, 4, log_hz=50.0)
    tip = SCHEMA.chain.tip_mm(SCHEMA.joint_positions(run.states))
    np.testing.assert_allclose(tip, SCHEMA.position_mm(run.states), atol=1.1e-3)


def test_the_wrist_shows_backlash() -> None:
    """Where the wrist is depends on where it came from: the loop is as wide as the play."""
    run = simulate(60.0, 7, log_hz=100.0)
    assert SCHEMA.chain is not None
    speed = run.states[:, SCHEMA.index(["jvel_5"])[0]]
    base = simulate(60.0, 7, log_hz=100.0, cables=Cables(backlash=(0.0,) * 7))
    spread = _error(run) - _error(base)
    forth, back = spread[speed > 10.0].mean(axis=0), spread[speed < -10.0].mean(axis=0)
    assert 0.5 < np.linalg.norm(forth - back) < 4.0  # 12 degrees at 13 mm: up to 2.7 mm


def test_what_the_tool_carries_stretches_the_cables() -> None:
    """By some tenths of a millimetre, in proportion."""
    empty, light, heavy = (
        _error(simulate(3.0, 5, log_hz=50.0, cables=Cables(payload_kg=mass)))[50:]
        for mass in (0.0, 0.05, 0.1)
    )
    by_light, by_heavy = (np.linalg.norm(one - empty, axis=1).mean() for one in (light, heavy))
    assert 0.05 < by_heavy < 2.0
    assert 0.3 < by_light / by_heavy < 0.8


def test_impossible_wear_is_refused() -> None:
    with pytest.raises(ConfigError, match="wear 0: expected a factor"):
        Cables(wear=0.0)


@pytest.mark.parametrize(("arm", "sign"), [("left", -1.0), ("right", 1.0)])
def test_torques_are_those_of_the_robots_own_software(arm: Any, sign: float) -> None:
    """Behind the gearbox: 49/4 and RE40 at the base, 26/7 and RE30 in the tool."""
    schema = raven_schema(arm)
    states = simulate(1.0, 4, arm=arm, log_hz=50.0).states
    for place, amps, per_amp in ((1, 1 / 2730, 0.0603 * 49 / 4), (6, 1 / 5461, 0.0538 * 26 / 7)):
        tau, dac = states[:, schema.index([f"tau_{place}", f"dac_val_{place}"])].T
        assert np.abs(dac).max() > 100
        np.testing.assert_allclose(tau, sign * per_amp * amps * dac, atol=0.51 * per_amp * amps)
