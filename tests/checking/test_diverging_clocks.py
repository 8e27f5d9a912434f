"""Clocks that no offset brings together are told to be unknown, not computed without end."""

from __future__ import annotations

import numpy as np
import pytest

from measure.checking import clocks
from measure.geometry.normal_equations import symmetric_inverse


@pytest.mark.parametrize("way", ["far", "nan", "singular"])
def test_clocks_that_diverge_are_unknown(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def reduced(*_: object) -> None:
        if way == "singular":
            raise np.linalg.LinAlgError

    step = np.full((2, 2), np.nan if way == "nan" else 1e3)
    monkeypatch.setattr(clocks, "_instants", lambda *_: [None])
    monkeypatch.setattr(clocks, "reduce_instant", reduced)
    monkeypatch.setattr(clocks, "bias_deviations", lambda *_: np.zeros((2, 2)))
    monkeypatch.setattr(clocks, "solve_clocks", lambda *_: (step, np.zeros((2, 2))))
    found, sd = clocks._estimate([], [], [None, None], np.zeros(2, bool), 0.3)
    assert np.all(found == 0)
    assert np.all(np.isinf(sd))


def test_what_a_matrix_does_not_determine_stays_put() -> None:
    inverse = symmetric_inverse(np.diag([4.0, 0.0, 1e-20]))
    assert np.allclose(np.diag(inverse), [0.25, 0.0, 1e20])
