"""What stamps show of their own errors: rounding, arrival, another unit."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import SessionError
from measure.session.timestamps import StampErrors, check_time_units

TRUE_S = np.arange(300) / 30


@pytest.mark.parametrize("quantum_s", [0.001, 0.01, 0.02, 1 / 64])
def test_rounded_stamps_have_the_error_of_rounding(quantum_s):
    stamps = np.unique(np.round(TRUE_S / quantum_s) * quantum_s)
    found = StampErrors.of(np.round(stamps, 6))
    np.testing.assert_allclose(found.sd_s, quantum_s / np.sqrt(12))
    assert any("rounded" in note for note in found.notes) == (quantum_s > 0.005)


def test_times_of_arrival_have_the_scatter_of_their_delays():
    rng = np.random.default_rng(1)
    stamps = TRUE_S + 0.05 + rng.normal(scale=0.003, size=len(TRUE_S))
    stamps[100] += 0.02  # one was held up
    found = StampErrors.of(stamps)
    assert np.median(found.sd_s) == pytest.approx(0.003, rel=0.35)
    assert found.sd_s[100] > 0.015
    assert any("arrival" in note for note in found.notes)


@pytest.mark.parametrize(
    "stamps",
    [
        TRUE_S,
        np.arange(300) / 25,
        np.delete(TRUE_S, [40, 41, 70]),
        np.delete(np.arange(300) / 25, [40, 41, 70]),
        np.cumsum(np.repeat([0.033, 0.04, 0.05], 100)),  # exposures grow as it gets dark
        np.cumsum(np.random.default_rng(2).uniform(0.03, 0.036, 300)),  # steps of their own
        TRUE_S[:5],
    ],
    ids=["even", "40 ms", "gaps", "gaps of 40 ms", "slower", "wandering", "few"],
)
def test_stamps_that_show_no_error_have_none(stamps):
    found = StampErrors.of(stamps)
    assert np.all(found.sd_s < 4e-4)


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_cameras_in_different_units_are_refused(factor):
    with pytest.raises(SessionError, match=r"'b' are .* one is in another unit; write seconds"):
        check_time_units({"a": 0.0333, "b": 0.0333 * factor, "c": 0.034})
    check_time_units({"a": 0.0333, "b": 0.2, "c": float("inf")})
