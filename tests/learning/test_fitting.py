"""Who is to blame where a fit ends early: the estimator, or who watches it."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import pytest

from measure.cli import main
from measure.errors import EstimatorError, FitError
from measure.host import Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import Split
from measure_learning.core.scores import fit
from measure_learning.estimators.offset import OffsetEstimator

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")

STRANGER = """
import json
from measure.host import hookimpl
from measure_learning.estimators.offset import OffsetEstimator

class Hasty(OffsetEstimator):
    "Reads a file that is not JSON."
    name = "hasty"

    def learn(self, data, validation, *, seed, report):
        json.loads("{")

@hookimpl
def measure_estimators():
    return [Hasty]
"""


def _fails(error: Exception):
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


class _Stop(Exception):  # noqa: N818
    """What a notebook's callback raises to end a fit."""


@pytest.mark.parametrize(("method", "doing"), [("learn", "fitting"), ("save", "saving")])
def test_an_estimator_that_fails_is_named(data, tmp_path, monkeypatch, capsys, method, doing):
    monkeypatch.setattr(OffsetEstimator, method, _fails(KeyError("no licence")))
    words = ["train", str(data), "-o", str(tmp_path / "model.onnx")]
    assert main([*words, "--estimator", "offset"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"fails ({doing}): KeyError: 'no licence' (test_fitting.py, line " in said
    assert re.search(r"estimator 'offset' of triball [\d.]+ fails", said)


def test_a_failing_plugin_is_named_with_its_own_line(data, tmp_path, capsys, install):
    """Not with the line of the library that it called wrongly."""
    install("acme-hasty", STRANGER, version="2.1")
    words = ["train", str(data), "-o", str(tmp_path / "model.onnx")]
    assert main([*words, "--estimator", "hasty"]) == 2
    said = capsys.readouterr().err
    assert "estimator 'hasty' of acme-hasty 2.1 fails (fitting): JSONDecodeError" in said
    assert said.rstrip().endswith("(acme_hasty_plugin.py, line 11)")


def test_a_sweep_whose_estimator_fails_names_it(data, tmp_path, monkeypatch, capsys):
    pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    monkeypatch.setattr(OffsetEstimator, "learn", _fails(TypeError("not a number")))
    space = tmp_path / "space.toml"
    space.write_text("")
    words = ["sweep", str(data), str(space), "--journal", str(tmp_path / "journal.log")]
    assert main([*words, "--estimator", "offset", "--trials", "2"]) == 2
    said = capsys.readouterr().err
    assert "2 trials failed and 0 finished; the last failure: estimator 'offset' of triball" in said
    assert "fails (fitting): TypeError: not a number (test_fitting.py, line " in said


def test_an_estimator_that_fails_without_an_input_is_named(data, tmp_path, monkeypatch, capsys):
    model = tmp_path / "model.onnx"
    assert main(["train", str(data), "-o", str(model), "--estimator", "offset"]) == 0
    capsys.readouterr()
    monkeypatch.setattr(OffsetEstimator, "learn", _fails(ZeroDivisionError("no spread")))
    assert main(["ablate", str(data), str(model), "--remove"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "fails (fitting): ZeroDivisionError: no spread (test_fitting.py, line " in said


def _asking(self, data, validation, *, seed, report):
    report(0.5, "half")


def _wrapping(self, data, validation, *, seed, report):
    try:
        report(0.5, "half")
    except _Stop as error:
        raise EstimatorError("interrupted") from error


def _stumbling(self, data, validation, *, seed, report):
    try:
        report(0.5, "half")
    finally:
        self.never_set.close()


@pytest.mark.parametrize("learn", [_asking, _wrapping, _stumbling])
def test_what_a_watcher_raises_comes_out_as_it_is(split: Split, monkeypatch, learn):
    monkeypatch.setattr(OffsetEstimator, "learn", learn)
    estimator = Registry.discover().build(Estimator, "offset", {})
    theirs = _Stop("enough")
    with pytest.raises(_Stop) as caught:
        fit(estimator, split.train, split.validation, seed=0, report=_fails(theirs))
    assert caught.value is theirs


def test_an_error_after_a_caught_stop_is_the_estimators(split: Split, monkeypatch):
    def learn(self, data, validation, *, seed, report):
        with suppress(_Stop):
            report(0.5, "half")
        raise IndexError("out of data")

    monkeypatch.setattr(OffsetEstimator, "learn", learn)
    estimator = Registry.discover().build(Estimator, "offset", {})
    with pytest.raises(FitError, match="IndexError: out of data"):
        fit(estimator, split.train, split.validation, seed=0, report=_fails(_Stop()))


@pytest.mark.parametrize("done", [float("nan"), -1.0, 7.0])
def test_nonsense_shares_are_no_watcher_s_mistake(
    data: Path, tmp_path: Path, monkeypatch, done: float
):
    right = OffsetEstimator.learn

    def learn(self, data, validation, *, seed, report):
        report(done, "so far")
        right(self, data, validation, seed=seed, report=quiet)

    monkeypatch.setattr(OffsetEstimator, "learn", learn)
    words = ["train", str(data), "-o", str(tmp_path / "model.onnx"), "--estimator", "offset"]
    assert main(words) == 0
