"""What a prediction leaves once its outline is moved: nothing of a shift, all of the rest."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.sampling.rays import CLEAR, OCCLUDED
from measure_plugins._outline.self_calibration.response_and_blur import aligned_residuals

STEP_PX, SAMPLES, RAYS, COMPARED = 0.5, 24, 30, 18
NONE = np.empty(0)


def edge(shift_px):
    """Smooth edges (3, m, n) of three colours, shifted outward by `shift_px` (n,)."""
    at = STEP_PX * np.arange(SAMPLES)[:, None] - 5.0 - shift_px
    return np.array([[[0.8]], [[0.5]], [[-0.3]]]) / (1 + np.exp(at / 1.5))


@pytest.fixture
def around():
    turns = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
    return np.stack([np.cos(turns), np.sin(turns)], axis=1)


def test_a_shift_and_growth_of_the_outline_leave_nothing(around):
    status = np.zeros(RAYS, np.int8)
    predicted = edge(np.zeros(RAYS))
    seen = edge(0.02 * around[:, 0] - 0.01 * around[:, 1] + 0.015)
    left, weights = aligned_residuals(seen, predicted, status, around, COMPARED, STEP_PX, NONE)
    assert left.shape == (RAYS, 3 * COMPARED)
    assert np.abs(left).max() < 0.1 * np.abs(seen - predicted).max()
    assert np.all((weights > 0) & (weights <= 1))


def test_what_is_no_shift_stays_and_hidden_rays_do_not_count(around):
    rng = np.random.default_rng(3)
    status = np.zeros(RAYS, np.int8)
    status[[4, 5, 20]] = OCCLUDED
    predicted = edge(np.zeros(RAYS))
    seen = predicted + 0.01 * rng.normal(size=predicted.shape)
    seen[:, :, status != CLEAR] += 1.0
    left, weights = aligned_residuals(seen, predicted, status, around, COMPARED, STEP_PX, NONE)
    assert left.shape == (RAYS - 3, 3 * COMPARED)
    expected, _ = by_numpy(seen, predicted, status, around, weights)
    again, same = aligned_residuals(seen, predicted, status, around, COMPARED, STEP_PX, weights)
    np.testing.assert_allclose(again, expected, atol=1e-12)
    assert np.array_equal(same, weights)
    assert np.sqrt(np.mean(left**2)) == pytest.approx(0.01, rel=0.1)


def test_a_ray_unlike_the_others_loses_its_weight(around):
    status, predicted = np.zeros(RAYS, np.int8), edge(np.zeros(RAYS))
    seen = predicted + 0.002 * np.random.default_rng(4).normal(size=predicted.shape)
    seen[:, :, 11] += 0.2
    _, weights = aligned_residuals(seen, predicted, status, around, COMPARED, STEP_PX, NONE)
    assert weights[11] < 0.01 * np.median(weights)


def by_numpy(seen, predicted, status, around, weights):
    """The same written with arrays."""
    use = status == CLEAR
    slope = -np.gradient(predicted, STEP_PX, axis=1)[:, :COMPARED][:, :, use]
    off = (seen - predicted)[:, :COMPARED][:, :, use]
    off, slope = (part.reshape(-1, part.shape[-1]).T for part in (off, slope))
    design = np.column_stack([around[use], np.ones(np.count_nonzero(use))])
    rows = np.sqrt(weights)[:, None, None] * slope[:, :, None] * design[:, None, :]
    values = np.sqrt(weights)[:, None] * off
    shift = np.linalg.lstsq(rows.reshape(-1, 3), values.ravel(), rcond=None)[0]
    return off - slope * (design @ shift)[:, None], shift
