"""Clocks that nothing determines are told to be unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.checking import clocks
from measure.geometry.normal_equations import symmetric_inverse
from tests.checking.test_clocks import CAMERAS, OFFSETS, moving, recorded
from tests.scenes import RAVEN


def test_clocks_that_diverge_are_unknown(monkeypatch) -> None:
    fit = clocks.fitted
    far = lambda *given: replace(found := fit(*given), values=1e3 + found.values)
    monkeypatch.setattr(clocks, "fitted", far)
    found = clocks.estimate_clocks(recorded(moving, OFFSETS, count=20), RAVEN, [*CAMERAS.values()])
    assert all(clock.offset_s == 0 and np.isinf(clock.offset_sd_s) for clock in found)


def test_what_a_matrix_does_not_determine_stays_put() -> None:
    inverse = symmetric_inverse(np.diag([4.0, 0.0, 1e-20]))
    assert np.allclose(np.diag(inverse), [0.25, 0.0, 1e20])
