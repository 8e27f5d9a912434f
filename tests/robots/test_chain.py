from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from measure.errors import DegenerateGeometryError
from measure.robots import SerialChain
from measure_learning.robots import find_schema, raven_chain
from measure_learning.robots.raven import drives_from_motors, joints_from_drives, motors_from_drives
from measure_learning.simulator import Slip

CHAINS = {
    "left": raven_chain("left"),
    "right": raven_chain("right"),
    "psm": find_schema("dvrk-psm").chain,
}

# Joint limits in the robot's software: rad, rad, mm.
LIMITS = ((0.0, np.pi / 2), (np.pi / 4, 3 * np.pi / 4), (230.0, 560.0))


def _joints(draw_from: np.random.Generator, count: int) -> np.ndarray:
    low = np.array([limit[0] for limit in LIMITS])
    high = np.array([limit[1] for limit in LIMITS])
    arm = draw_from.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low), (count, 3))
    return np.concatenate([arm, draw_from.uniform(-0.7, 0.7, (count, 3))], axis=1)


@pytest.mark.parametrize("name", CHAINS)
def test_jacobian_is_the_derivative_of_the_pose(name: str) -> None:
    chain = CHAINS[name]
    assert isinstance(chain, SerialChain)
    q = _joints(np.random.default_rng(1), 20)
    for joint in range(chain.size):
        step = np.zeros(chain.size)
        step[joint] = 1e-5
        numeric = chain.pose(q + step).difference(chain.pose(q - step)) / 2e-5
        np.testing.assert_allclose(chain.jacobian(q)[..., joint], numeric, atol=1e-5)


@pytest.mark.parametrize("name", CHAINS)
def test_inverse_kinematics_returns_to_the_tip(name: str) -> None:
    chain = CHAINS[name]
    rng = np.random.default_rng(2)
    q = _joints(rng, 50)
    start = q + rng.normal(0.0, 0.05, q.shape) * np.array([1, 1, 100, 1, 1, 1])
    start[:, 3:] = q[:, 3:]
    tips = chain.tip_mm(chain.solve_tip(chain.tip_mm(q), start, (0, 1, 2)))
    np.testing.assert_allclose(tips, chain.tip_mm(q), atol=1e-5)


def test_a_tip_out_of_reach_is_refused() -> None:
    chain = find_schema("dvrk-psm").chain
    short = SerialChain(chain.joints[:2] + chain.joints[3:], chain.tool)
    with pytest.raises(DegenerateGeometryError, match="1 of 1 tip positions cannot be reached"):
        short.solve_tip([0.0, 0.0, 900.0], np.full(5, 0.1), (0, 1, 3))


def test_the_ravens_first_two_axes_meet_in_the_remote_centre() -> None:
    """The mechanism is spherical: turning shoulder and elbow keeps the tip's distance."""
    rng = np.random.default_rng(3)
    q = _joints(rng, 30)
    q[:, 2:] = q[0, 2:]
    distance = np.linalg.norm(CHAINS["left"].tip_mm(q), axis=1)  # type: ignore[union-attr]
    np.testing.assert_allclose(distance, distance[0], atol=1e-9)
    longer = q + np.array([0, 0, 10.0, 0, 0, 0])
    moved = CHAINS["left"].tip_mm(longer) - CHAINS["left"].tip_mm(q)  # type: ignore[union-attr]
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 10.0, atol=1e-9)


@given(st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7))
@settings(max_examples=50)
def test_transmission_goes_both_ways(values: list[float]) -> None:
    drives = np.array(values)
    np.testing.assert_allclose(drives_from_motors(motors_from_drives(drives)), drives, atol=1e-12)


def test_transmission_numbers_of_the_control_software() -> None:
    theta1, theta2, d3 = 0.5, 1.2, 0.4
    motors = motors_from_drives([theta1, theta2, d3, 0, 0, 0, 0])
    assert motors[1] / 121.522 - 0.14545 * theta1 == pytest.approx(theta2, abs=1e-9)
    expected = motors[2] / 2158.59 - 0.0077974 * theta1 - 0.0080774 * theta2
    assert expected == pytest.approx(d3, abs=1e-9)
    assert joints_from_drives([0, 0, 0.4, 0, 0, 0.3, -0.1])[[2, 5]] == pytest.approx([400.0, 0.2])


def test_psm_chain_agrees_with_the_data_sets_own_kinematics(shared: Path) -> None:
    folder = shared / "data" / "dvrk_joint_errors"
    if not folder.exists():
        pytest.skip("no ../shared/data/dvrk_joint_errors")
    sys.path.insert(0, str(folder))
    try:
        import fk  # type: ignore[import-not-found]
    finally:
        sys.path.remove(str(folder))
    q = np.random.default_rng(4).uniform(-0.7, 0.7, (40, 6))
    metres = q.copy()
    q[:, 2] *= 1000.0
    chain = find_schema("dvrk-psm").chain
    np.testing.assert_allclose(chain.tip_mm(q), fk.tip_mm(metres), atol=1e-9)


SIZE = (1e-3, 1e-3, 1e-4, 1e-2, 1e-2, 1e-2, 1e-2)


def _to_and_fro(speed: float, step_s: float = 0.02) -> np.ndarray:
    """A triangle of 0.1 rad at a speed, and 30 s of rest at its top."""
    way = np.arange(0.0, 0.1, speed * step_s)
    top = np.full(round(30.0 / step_s), 0.1)
    return np.tile(np.concatenate([way, way[::-1], way, top])[:, None], 7)


def test_slip_is_hysteresis_bounded_and_of_either_sign() -> None:
    links = _to_and_fro(0.5)
    errors = Slip(SIZE).errors(links, 0.02)
    assert (np.abs(errors) <= np.array(SIZE) + 1e-12).all()
    up, down = 5, 14  # the same place (0.05) on the way up and down
    assert links[up] == pytest.approx(links[down])
    assert (errors[up, 3:] < 0).all()
    assert (errors[down, 3:] > errors[up, 3:] + 0.5 * np.array(SIZE[3:])).all()


def test_slip_creeps_at_rest_and_feels_the_rate_where_a_play_does_not() -> None:
    fast, slow = (Slip(SIZE).errors(_to_and_fro(v), 0.02) for v in (0.5, 2e-4))
    assert abs(fast[-1, 3]) < 0.1 * abs(fast[-1500, 3])  # a play would stay where it is
    assert (abs(fast).max(axis=0) > 1.5 * abs(slow).max(axis=0))[3:].all()
    stiff = Slip(SIZE, relaxation_s=1e9).errors(_to_and_fro(0.5), 0.02)
    assert stiff[-1] == pytest.approx(stiff[-1500])


def test_drift_grows_within_a_session() -> None:
    still = np.zeros((1000, 7))
    errors = Slip((0.0,) * 7, drift=SIZE, drift_s=5.0).errors(still, 0.02)
    assert errors[0] == pytest.approx(0.0)
    assert errors[-1] == pytest.approx(np.array(SIZE) * (1 - np.exp(-19.98 / 5.0)))
