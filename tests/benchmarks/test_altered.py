"""Recordings as other cameras would have taken them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.altered import (
    ALTERATIONS,
    RESIZED,
    altered_copy,
    contrast,
    defocused,
    dim,
    lateral,
    overexposed,
    smoothed,
    vignetted,
)
from benchmarks.recordings import ALTERED, altered_recordings, recordings_beside
from measure.session import open_session, read_body
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


@pytest.mark.parametrize("how", RESIZED)
def test_only_the_radii_that_the_body_file_says_change(recording, tmp_path, how):
    altered_copy(recording, tmp_path / how, how)
    stated, true = read_body(tmp_path / how / "body.toml"), read_body(recording / "body.toml")
    np.testing.assert_allclose(stated.radii / true.radii, RESIZED[how])
    np.testing.assert_array_equal(stated.centers, true.centers)
    assert np.array_equal(_first(tmp_path / how), _first(recording))


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


def test_what_alterations_do_to_light():
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(2, 2, 3)
    grey = np.full((20, 20, 3), 0.5, np.float32)
    middle = (values > 0.1) & (values < 0.9)
    assert np.all((contrast(values) < values)[middle & (values < 0.5)])
    assert np.all((contrast(values) > values)[middle & (values > 0.5)])
    assert np.all(overexposed(values) >= values - 1e-6)
    assert overexposed(np.full((1, 1, 3), 0.9, np.float32)).max() == pytest.approx(1.0)
    assert dim(grey).mean() == pytest.approx(0.26, abs=0.02)  # a quarter of the light of 0.5
    assert defocused(grey) == pytest.approx(grey, abs=1e-3)
    edge = np.where(np.arange(40)[None, :, None] < 20, 0.0, 0.8) * np.ones((40, 40, 3))
    assert np.ptp(np.diff(defocused(edge.astype(np.float32))[20, :, 0])) < 0.4


def test_what_alterations_do_to_webcam_pictures():
    grey = np.full((90, 120, 3), 0.5, np.float32)
    assert lateral(grey) == pytest.approx(grey, abs=1e-3)
    right, down = np.meshgrid(np.arange(120.0), np.arange(90.0))
    ramp = np.repeat(((right + down) / 300)[:, :, None], 3, axis=2).astype(np.float32)
    moved = (lateral(ramp) - ramp)[80, 110] * 300 / np.sqrt(2)
    # Along the ramp, from the middle; the corners are half a pixel off.
    along = (50.5 + 35.5) / np.sqrt(2) * 0.5 / np.hypot(59.5, 44.5)
    assert moved == pytest.approx([along, 0, -along], abs=0.07)  # 1 in 32 px
    shaded = vignetted(grey)
    assert shaded[45, 60] == pytest.approx(0.5, abs=0.01)
    assert shaded[0, 0] == pytest.approx(0.36, abs=0.01)  # half of the light of 0.5
    grey[20, 30] = 1
    assert smoothed(grey).max() == 0.5


def test_every_recording_beside_is_altered_in_every_way():
    ways = (*ALTERATIONS, *RESIZED)
    names = {f"{ALTERED}{name} {how}" for name in recordings_beside() for how in ways}
    assert set(altered_recordings()) == names
