"""A fit goes on from where it was interrupted, if it is the same fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from measure.errors import EstimatorError
from measure.host import Dataset
from measure.learning import split_by_trajectory
from measure_plugins.estimators._checkpoint import Checkpoint


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
        assert Checkpoint(tmp_path, "net", key).load() == found


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    checkpoint = Checkpoint(tmp_path, "net", 1)
    checkpoint.store(now=True, net=7)
    content = (tmp_path / "net.pt").read_bytes()
    for damaged in (b"", b"junk", content[: len(content) // 2]):
        (tmp_path / "net.pt").write_bytes(damaged)
        with pytest.raises(EstimatorError, match=r"net.pt: damaged .* train again without"):
            checkpoint.load()
