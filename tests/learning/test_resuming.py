"""A fit goes on from where it was interrupted, if it is the same fit."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from measure.cli import main
from measure.errors import EstimatorError
from measure.host import Dataset
from measure_learning.core import split_by_trajectory
from measure_learning.estimators._nets import Grus, Perceptrons
from measure_learning.onnx import Checkpoint


def test_a_fit_is_not_resumed_with_other_data(small: Dataset, tmp_path: Path) -> None:
    """Nor with another split of the same: what it was tested on would have been learnt from."""
    pytest.importorskip("torch")
    split, other = split_by_trajectory(small, seed=3), split_by_trajectory(small, seed=4)
    relabelled = replace(split.train, errors_mm=-split.train.errors_mm)
    key = split.train.digest(), split.validation.digest()
    Checkpoint(tmp_path, "net", key).store(now=True, net=7)
    for train, validation, found in (
        (split.train, split.validation, {"net": 7}),
        (relabelled, split.validation, None),
        (split.train, other.validation, None),
        (other.train, other.validation, None),
    ):
        key = train.digest(), validation.digest()
        assert Checkpoint(tmp_path, "net", key).load(dict) == found


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    checkpoint = Checkpoint(tmp_path, "net", 1)
    checkpoint.store(now=True, net=7)
    content = (tmp_path / "net.pt").read_bytes()
    for damaged in (b"", b"junk", content[: len(content) // 2]):
        (tmp_path / "net.pt").write_bytes(damaged)
        with pytest.raises(EstimatorError, match=r"net.pt: damaged .* train again without"):
            checkpoint.load(dict)


@dataclass
class _Hostile:
    """Unpickles as a call that makes a file."""

    mark: Path

    def __reduce__(self) -> tuple[Any, tuple[str, ...]]:
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("estimator", ["mlp", "stream"])
def test_no_code_in_a_checkpoint_runs(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], estimator: str
) -> None:
    torch = pytest.importorskip("torch")
    folder, mark = tmp_path / "model.checkpoint", tmp_path / "ran"
    folder.mkdir()
    file = folder / {"mlp": "mlp.pt", "stream": "perceptrons.pt"}[estimator]
    torch.save({"key": "1", "net": _Hostile(mark)}, file)
    words = ["train", str(data), "-o", str(tmp_path / "model.onnx"), "--estimator", estimator]
    assert main([*words, "--resume"]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "training" not in line]
    assert len(lines) == 1
    assert f"{file}: damaged (" in lines[0]
    assert not mark.exists()
    torch.load(file, weights_only=False)
    assert mark.exists(), "the payload is one"


@pytest.mark.parametrize("values", [{}, {"net": 1}, {"net": {"weights": 1, "biases": []}}])
def test_a_checkpoint_of_other_values_is_named(
    small: Dataset, tmp_path: Path, values: dict[str, Any]
) -> None:
    """It may be of the same fit, and yet hold what no fit wrote."""
    pytest.importorskip("torch")
    Checkpoint(tmp_path, "perceptrons", 1).store(now=True, **values)
    with pytest.raises(EstimatorError, match=r"perceptrons.pt: damaged .* without --resume"):
        Checkpoint(tmp_path, "perceptrons", 1).load(
            lambda state: Perceptrons.from_values(state["net"])
        )


def test_nets_come_back_as_they_were_stored(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    dice = np.random.default_rng(1)
    head = Perceptrons((dice.random((1, 2, 3)),), (dice.random((1, 1, 3)),))
    net = Grus(*(dice.random((1, n, 6)) for n in (4, 2, 1, 1)), head=head)
    Checkpoint(tmp_path, "net", 1).store(now=True, net=net.values())
    back = Checkpoint(tmp_path, "net", 1).load(lambda state: Grus.from_values(state["net"]))
    for name in ("from_input", "from_hidden", "input_bias", "hidden_bias"):
        np.testing.assert_array_equal(getattr(back, name), getattr(net, name))
    np.testing.assert_array_equal(back.head.weights[0], head.weights[0])
