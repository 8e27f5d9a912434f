from __future__ import annotations

import numpy as np
import pytest

from measure.calibration.refining.priors import NoiseModel, shrunken_variance, with_view_noise
from measure.calibration.refining.recording import Track


def views(correlation: float, extra_px: float, count: int = 3000) -> tuple[np.ndarray, Track]:
    """Residuals that hang together from frame to frame (autoregressive), of one ball."""
    rng = np.random.default_rng(1)
    steps = rng.normal(size=(count, 2)) * np.sqrt(1 - correlation**2)
    for i in range(1, count):
        steps[i] += correlation * steps[i - 1]
    stated = np.tile(np.diag([0.01, 0.04]), (count, 1, 1))
    total = np.sqrt(np.diagonal(stated, axis1=1, axis2=2) + extra_px**2)
    whole = np.arange(count)
    return steps * total, Track(whole, 0 * whole, steps, stated, np.zeros(count))


@pytest.mark.parametrize("extra_px", [0.05, 0.3])
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_extra_scatter_and_correlation_are_found(correlation: float, extra_px: float) -> None:
    residuals, track = views(correlation, extra_px)
    found = with_view_noise(NoiseModel(), {"a": residuals}, {"a": track}, 1.0, 0.01, 1.0)
    assert found.view_px == pytest.approx(extra_px, rel=0.1)
    expected = (1 + correlation) / (1 - correlation)
    assert found.correlation == pytest.approx(expected, rel=0.2)


def test_stated_scatter_that_is_too_large_is_left() -> None:
    residuals, track = views(0.0, 0.0)
    found = with_view_noise(NoiseModel(), {"a": residuals / 3}, {"a": track}, 1.0, 0.01, 1.0)
    assert found.view_px == 0.01


def test_a_variance_is_between_what_is_seen_and_what_is_usual() -> None:
    assert shrunken_variance(0.0, 0.0, 2.0) == 2.0
    assert shrunken_variance(1000.0, 1000.0, 2.0) == pytest.approx(1.0, rel=0.01)


def test_half_the_way_between_two() -> None:
    one, other = NoiseModel(view_px=0.1), NoiseModel(view_px=0.4)
    assert one.towards(other).view_px == pytest.approx(0.2)
    assert one.differs(other)
    assert not one.differs(one)
