"""Offsets of clocks written into a session file, which keeps everything else."""

from __future__ import annotations

import tomllib

import pytest

from measure.errors import SessionError
from measure.session.timestamps import add_time_offsets

TEXT = """# by hand
[session]
name = "s"

[[cameras]]  # left
name = "a"
video = "a.mp4"

[[cameras]]
time_offset_s = 0.5  # measured
name = "b"
video = "b.mp4"

[robot]
log = "x"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "session.toml"
    path.write_text(TEXT)
    return path


def test_offsets_are_added_and_the_rest_stays(file):
    text = add_time_offsets(file, {"a": -1.25, "b": 0.25}, overwrite=True)
    cameras = tomllib.loads(text)["cameras"]
    assert [camera["time_offset_s"] for camera in cameras] == [-1.25, 0.75]
    kept = [line for line in text.splitlines() if "time_offset_s" not in line]
    assert kept == [line for line in TEXT.splitlines() if "time_offset_s" not in line]
    assert "time_offset_s = 0.750000  # measured" in text


def test_an_offset_is_never_replaced_unasked(file):
    with pytest.raises(
        SessionError, match=r"b has time_offset_s = 0\.5 already: --overwrite makes"
    ):
        add_time_offsets(file, {"a": 0.0, "b": 1.0})
    assert file.read_text() == TEXT


def test_cameras_written_otherwise_are_left_to_the_user(file):
    file.write_text('cameras = [{name = "a"}, {name = "b"}]\n[session]\n')
    with pytest.raises(SessionError, match=r"or add to their times: a \+0\.100000, b \+0"):
        add_time_offsets(file, {"a": 0.1, "b": 0.0})
