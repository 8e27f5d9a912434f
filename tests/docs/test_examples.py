"""The example notebooks run as scripts."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from measure_learning.api import shipped_model
from measure_learning.onnx import OnnxModel
from tests.docs.pages import ROOT

EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.py"))

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
"""The first one compiles everything on a machine that has just been set up."""


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_measures_evaluates_and_plots(example: Path, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(example), str(tmp_path / "out")])
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr().out
    error_mm = float(re.search(r"position error ([\d.]+) mm RMS", printed)[1])
    assert error_mm < 0.15, printed
    assert "plotly" in (tmp_path / "out" / "errors.html").read_text(encoding="utf-8").lower()


def test_ten_lines_of_onnxruntime_correct_as_the_program_does(rng):
    """To the bit, over ticks and states between them."""
    corrector = runpy.run_path(str(ROOT / "docs/examples/onnx/correct.py"))["Corrector"]
    model = OnnxModel.load(shipped_model())
    alone = corrector(str(shipped_model()))
    state = rng.normal(size=len(model.features))
    for time_s in np.cumsum(rng.uniform(0.001, 0.1, 50)):
        state = state + 0.01 * rng.normal(size=len(state))
        error_mm, covariance, strangeness = alone.correct(state, time_s)
        expected = model.update(state, time_s)
        np.testing.assert_array_equal(error_mm, expected.error_mm)
        np.testing.assert_array_equal(covariance, expected.covariance)
        assert (strangeness > 1) == expected.unfamiliar


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_uses_public_names_only(example: Path):
    imported = re.findall(r"^(?:from|import) (measure\S*)", example.read_text(), re.MULTILINE)
    assert set(imported) <= {"measure", "measure.api", "measure.host"}
