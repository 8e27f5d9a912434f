"""Folders of strangers: nothing is waited for, and nothing written through links."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from measure.cli import main
from tests.cli.test_bad_input import complaint, run_words
from tests.session.conftest import Recording, write_recording

_FILES = ("session.toml", "body.toml", "calibration.toml", "cam1.csv", "cam1/000002.jpg")


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return write_recording(tmp_path / "rec")


@pytest.mark.parametrize("name", _FILES)
def test_a_pipe_among_a_sessions_files(recording: Recording, name: str, capsys) -> None:
    file = recording.path / name
    file.unlink()
    os.mkfifo(file)
    line = complaint(capsys, *run_words(recording))
    assert f"{name}: is a pipe, not an ordinary file" in line


def test_a_link_to_a_device_among_a_sessions_files(recording: Recording, capsys) -> None:
    file = recording.path / (name := "cam1.csv")
    file.unlink()
    file.symlink_to("/dev/zero")
    line = complaint(capsys, *run_words(recording))
    assert f"{name}: is a device, not an ordinary file" in line


def test_a_video_that_is_a_device(recording: Recording, capsys) -> None:
    recording.replace("session.toml", 'images = "cam1/*.jpg"', 'video = "/dev/zero"')
    assert "/dev/zero: is a device" in complaint(capsys, *run_words(recording))


@pytest.mark.parametrize("pattern", ["/**/*.jpg", "../**/*.jpg", "/*/*/*/*.jpg", "a/../*/*/*"])
def test_a_pattern_that_searches_everything(recording: Recording, pattern: str, capsys) -> None:
    recording.replace("session.toml", "cam1/*.jpg", pattern)
    line = complaint(capsys, *run_words(recording))
    assert f"{pattern}: would search folders without end" in line


def test_links_in_a_circle_are_not_followed(recording: Recording, capsys) -> None:
    """Each pair of them doubles the places at every depth, up to 40 deep."""
    for name in ("a", "b"):
        (recording.path / name).symlink_to(recording.path)
    recording.replace("session.toml", "cam1/*.jpg", "**/cam1/*.jpg")
    assert main([*run_words(recording)]) == 0


@pytest.mark.parametrize("name", ["poses.parquet", "balls.arrows", "run.toml"])
def test_a_pipe_among_a_runs_files(recording: Recording, name: str, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    file = recording.path.with_name("run") / name
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    capsys.readouterr()
    line = complaint(capsys, "report", file.parent)
    assert f"{name}: is a pipe, not an ordinary file" in line


@pytest.mark.parametrize("command", ["report", "export"])
@pytest.mark.parametrize("there", [True, False])
def test_nothing_is_written_through_a_link(
    recording: Recording, command: str, there: bool, capsys
) -> None:
    assert main([*run_words(recording)]) == 0
    run, precious = recording.path.with_name("run"), recording.path.with_name("precious.html")
    if there:
        precious.write_text("a thesis")
    words = {
        "report": ("report.html",),
        "export": ("export.csv", "--format", "csv", "--overwrite"),
    }[command]
    (run / words[0]).symlink_to(precious)
    capsys.readouterr()
    line = complaint(capsys, command, run, *words[1:])
    assert f"{words[0]}" in line
    assert f"is a link to {precious}" in line
    assert precious.exists() == there
    assert not there or precious.read_text() == "a thesis"


def test_a_run_is_not_written_into_what_a_link_leads_to(recording: Recording, capsys) -> None:
    there, link = recording.path.with_name("precious"), recording.path.with_name("run")
    there.mkdir()
    link.symlink_to(there)
    line = complaint(capsys, *run_words(recording))
    assert f"{link}: is a link to {there}: give the folder itself" in line
    assert not list(there.iterdir())


@pytest.mark.parametrize("name", ["summary.json", "poses.arrows"])
@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_run_writes_through_no_link(recording: Recording, name: str, how: str, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    run, precious = recording.path.with_name("run"), recording.path.with_name("precious")
    (run / name).unlink(missing_ok=True)
    precious.write_bytes(b"a thesis")
    (run / name).symlink_to(precious)
    capsys.readouterr()
    line = complaint(capsys, *run_words(recording, how))
    assert f"{run / name} is a link to {precious}" in line
    assert precious.read_bytes() == b"a thesis"
