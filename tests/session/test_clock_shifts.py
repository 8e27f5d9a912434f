"""Stamps that a refined calibration has set right: those it was refined from, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import CalibrationError
from measure.session import (
    Calibration,
    clock_values,
    open_session,
    read_calibration,
    write_calibration,
)
from tests.session.conftest import write_recording


@pytest.fixture
def folder(tmp_path):
    return write_recording(tmp_path / "rec", cameras=2, frames=6).path


def stamps(folder, calibration=None):
    with open_session(folder, calibration=calibration) as session:
        return {n: s.times_s.copy() for n, s in session.streams.items()}, session


def refined(folder, path, shifts):
    """A calibration that found these shifts in this recording."""
    _, session = stamps(folder)
    given = read_calibration(folder / "calibration.toml")
    known = {**given.provenance, **clock_values(session.clock_digest, shifts)}
    write_calibration(path, Calibration(given.cameras, known))
    return path


def test_clocks_of_the_refined_recording_are_shifted_with_a_note(folder, tmp_path):
    before, _ = stamps(folder)
    names = list(before)
    path = refined(folder, tmp_path / "c.toml", {names[0]: 0.0, names[1]: 0.007})
    after, session = stamps(folder, path)
    np.testing.assert_allclose(after[names[1]] - before[names[1]], 0.007, atol=1e-12)
    np.testing.assert_array_equal(after[names[0]], before[names[0]])
    assert any(f"{names[1]} +7.0 ms" in note for note in session.notes)
    assert session.clock_shifts_s == {names[0]: 0.0, names[1]: 0.007}


def test_images_carry_the_time_that_was_set_right(folder, tmp_path):
    before, _ = stamps(folder)
    name = list(before)[1]
    path = refined(folder, tmp_path / "c.toml", {name: 0.007})
    with open_session(folder, calibration=path) as session:
        assert session.streams[name].read(2).time_s == pytest.approx(before[name][2] + 0.007)


def test_another_recording_has_clocks_of_its_own(folder, tmp_path):
    other = write_recording(tmp_path / "other", cameras=2, frames=7).path
    names = list(stamps(folder)[0])
    path = refined(folder, tmp_path / "c.toml", {names[1]: 0.007})
    before, _ = stamps(other)
    after, session = stamps(other, path)
    for name in names:
        np.testing.assert_array_equal(after[name], before[name])
    assert session.clock_shifts_s == {}
    assert not any("clock" in note for note in session.notes)


def test_the_fingerprint_is_that_of_the_stamps_as_recorded(folder, tmp_path):
    plain = stamps(folder)[1].clock_digest
    path = refined(folder, tmp_path / "c.toml", {"cam1": 0.007})
    assert stamps(folder, path)[1].clock_digest == plain


def test_shifts_that_are_no_times_are_one_line(folder, tmp_path):
    path = refined(folder, tmp_path / "c.toml", {"cam1": 0.007})
    path.write_text(path.read_text().replace("cam1 = 0.007", 'cam1 = "late"'))
    with pytest.raises(CalibrationError, match="clock_shifts_s must name cameras and seconds"):
        open_session(folder, calibration=path)
