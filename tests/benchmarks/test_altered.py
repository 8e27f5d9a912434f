"""Recordings as other cameras would have taken them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.altered import ALTERATIONS, altered_copy
from measure.session import open_session
from tests.simulated.sessions import part_of


@pytest.fixture(scope="module")
def recording(still, tmp_path_factory):
    return part_of(still, range(2), tmp_path_factory.mktemp("altered") / "still")


def _first(folder):
    return cv2.imread(str(sorted(folder.glob("cam0/*.jpg"))[0])).astype(int)


@pytest.mark.parametrize("how", ALTERATIONS)
def test_only_pictures_change(recording, tmp_path, how):
    before = _first(recording)
    altered_copy(recording, tmp_path / how, how)
    assert np.array_equal(_first(recording), before)
    assert np.mean(np.abs(_first(tmp_path / how) - before)) > (0.01 if how == "lateral" else 0.5)
    for name in ("truth.csv", "calibration.toml", "body.toml", "cam0.csv"):
        assert (tmp_path / how / name).read_bytes() == (recording / name).read_bytes()
    with open_session(tmp_path / how) as session:
        assert sum(1 for _ in session.frame_sets()) == 2


def test_a_copy_that_is_there_is_kept_and_a_half_made_one_is_not(recording, tmp_path):
    kept, half_made = tmp_path / "kept", tmp_path / "new.part"
    kept.mkdir()
    half_made.mkdir()
    (half_made / "left over").touch()
    altered_copy(recording, kept, "dim")
    altered_copy(recording, tmp_path / "new", "dim")
    assert not list(kept.iterdir())
    assert not (tmp_path / "new" / "left over").exists()
    assert not half_made.exists()
