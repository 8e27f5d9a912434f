"""A camera's clock against ours: delays vary, clocks drift and are set anew."""

from __future__ import annotations

import numpy as np
import pytest

from measure_studio.capture.cameras import DeviceClock


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


def test_without_a_device_clock_arrival_is_the_time():
    assert DeviceClock().time_s(12.5, None) == 12.5


def test_pictures_in_a_late_burst_keep_their_times(taken_s):
    """As when a radio link is gone for three seconds."""
    arrived = taken_s + 0.02
    gone = (taken_s > 1020.0) & (taken_s < 1023.0)
    arrived[gone] = 1023.02 + 1e-4 * np.arange(np.count_nonzero(gone))
    off = off_s(taken_s, arrived, taken_s - 977.0)
    np.testing.assert_allclose(off, 0.02, atol=1e-9)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_a_clock_that_counts_no_seconds_is_not_believed(taken_s, unit):
    """Since 1970, as some cameras do: its digits must not reach the times."""
    clock = DeviceClock()
    arrived = taken_s + 0.02
    times = [clock.time_s(a, (1.7e9 + t) * unit) for a, t in zip(arrived, taken_s, strict=True)]
    np.testing.assert_allclose(times, arrived, atol=1e-9)
    assert not clock.runs


def test_seconds_since_1970_keep_their_digits(taken_s):
    off = off_s(taken_s, taken_s + 0.02, taken_s + 1.7e9)
    np.testing.assert_allclose(off, 0.02, atol=1e-6)


def test_a_clock_that_stands_still_is_not_believed(taken_s):
    clock = DeviceClock()
    assert [clock.time_s(t, 5.0) for t in taken_s] == list(taken_s)
    assert not clock.runs


def test_a_clock_that_runs_says_so_although_it_was_set_anew(taken_s):
    clock = DeviceClock()
    assert not clock.runs
    for t in taken_s:
        clock.time_s(t, t - 977.0 - 5000.0 * (t > 1050.0))
    assert clock.runs


def in_order(arrived_s):
    """A picture that is late holds up those that follow."""
    return np.maximum.accumulate(arrived_s)


def sds_s(taken_s, arrived_s, device_s):
    """Errors of times, and the standard deviations that are stated of them."""
    clock, out = DeviceClock(), []
    for taken, arrived, device in zip(taken_s, arrived_s, device_s, strict=True):
        out.append((clock.time_s(arrived, device) - taken, clock.sd_s))
    return np.array(out).T


@pytest.mark.parametrize("before", [0, 1000])
def test_a_time_of_arrival_states_how_late_it_is(taken_s, rng, before):
    """From the first on, where a camera sent stamps before; those are exact."""
    arrived = in_order(taken_s + late_s(rng, len(taken_s)))
    device = [taken - 977.0 if k < before else None for k, taken in enumerate(taken_s)]
    off, sd = sds_s(taken_s, arrived, device)
    assert np.all(sd[30:before] == 0)
    later = slice(max(before, 32), None)
    error = off[later] - 0.02  # what every picture takes at least
    assert np.quantile(error / sd[later], 0.99) < 2
    assert np.quantile(error / 0.007, 0.99) > 10  # the control: the median of how late they are
    assert np.median(sd[later]) < 0.03  # no more than the RMS of that jitter
    held_up = error > 0.1
    assert np.quantile(sd[later][held_up] / error[held_up], 0.05) > 0.5


def test_times_of_arrival_that_are_even_are_certain(taken_s, rng):
    """Pictures missing now and then, and ours for a clock that is a little slow, change nothing."""
    there = rng.random(len(taken_s)) > 0.1
    taken = taken_s[there]
    _, sd = sds_s(taken, 1.0002 * taken + 2e-4 * rng.random(len(taken)), [None] * len(taken))
    after_gap = np.concatenate([[False], np.diff(taken) > 0.05])
    assert sd[~after_gap].max() < 5e-4
    assert sd.max() < 0.11  # what comes after a gap may have been held up: nobody can say yet


def test_a_clock_that_is_set_anew_is_as_uncertain_as_the_arrival_it_is_tied_to(taken_s, rng):
    arrived = in_order(taken_s + late_s(rng, len(taken_s)))
    arrived = in_order(arrived + 0.08 * (np.arange(len(taken_s)) == 1500))
    device = taken_s - 977.0
    device[1500:] -= 5000.0
    off, sd = sds_s(taken_s, arrived, device)
    assert off[1500] - 0.02 > 0.08
    assert sd[1500] > 0.07
    assert sd[1600] < 1e-3
    assert np.all(off[1500:] - 0.02 < 2 * sd[1500:] + 5e-3)


def test_stamps_that_run_backwards_are_times_of_arrival_from_the_first_on(taken_s, rng):
    arrived = in_order(taken_s + late_s(rng, len(taken_s)))
    device = np.where(np.arange(len(taken_s)) < 1000, taken_s - 977.0, 5e3 - taken_s)
    off, sd = sds_s(taken_s, arrived, device)
    assert np.quantile((off - 0.02)[1000:] / np.maximum(sd[1000:], 2e-3), 0.99) < 2
