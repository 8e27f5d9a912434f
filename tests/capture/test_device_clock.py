"""A camera's clock against ours: delays vary, clocks drift and are set anew."""

from __future__ import annotations

import numpy as np
import pytest

from measure.capture.device_clock import DeviceClock


def off_s(taken_s, arrived_s, device_s):
    """Times made of arrivals and stamps, minus true ones."""
    clock = DeviceClock()
    return np.array(
        [clock.time_s(a, d) - t for t, a, d in zip(taken_s, arrived_s, device_s, strict=True)]
    )


@pytest.fixture
def taken_s():
    return 1000.0 + np.arange(3000) / 30


def late_s(rng, count):
    """20 ms at least, often 10 ms more, now and then a tenth of a second."""
    return 0.02 + rng.exponential(0.01, count) + 0.1 * (rng.random(count) < 0.02)


def test_delays_that_vary_become_one_that_does_not(taken_s, rng):
    arrived = taken_s + late_s(rng, len(taken_s))
    off = off_s(taken_s, arrived, taken_s - 977.0)[30:]
    assert off.min() > 0.02
    assert off.max() < 0.0215
    assert np.ptp(arrived - taken_s) > 0.1  # the control: times of arrival


def test_a_clock_that_drifts_is_followed(taken_s, rng):
    """A hundred parts in a million: 10 ms over this recording."""
    device = (taken_s - 1000.0) * (1 + 1e-4)
    off = off_s(taken_s, taken_s + late_s(rng, len(taken_s)), device)[30:]
    assert np.ptp(off) < 0.004


def test_a_clock_that_is_set_anew_is_believed_anew(taken_s, rng):
    device = taken_s - 977.0
    device[1500:] -= 5000.0
    off = off_s(taken_s, taken_s + late_s(rng, len(taken_s)), device)
    assert np.ptp(np.delete(off, np.s_[:30])[:1400]) < 0.0015
    assert np.ptp(off[1530:]) < 0.0015


def test_without_a_clock_of_its_own_a_picture_is_taken_when_it_arrives():
    assert DeviceClock().time_s(12.5, None) == 12.5
