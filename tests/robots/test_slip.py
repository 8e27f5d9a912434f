"""The simulator's hysteresis that no estimator contains."""

from __future__ import annotations

import numpy as np
import pytest

from measure_learning.simulator import Slip

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
