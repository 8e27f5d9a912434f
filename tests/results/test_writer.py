"""Kills and tears, struck wherever it hurts."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from measure.errors import RunError
from measure.results import RunWriter, read_run
from tests.results.conftest import (
    BODY,
    CAMERAS,
    check_whole,
    go_on,
    made_from,
    measurement,
    open_writer,
)


def test_times_from_1970_keep_their_nanoseconds(folder: Path) -> None:
    with open_writer(folder) as writer:
        writer.append(dataclasses.replace(measurement(0), time_s=1_700_000_000.123456))
        writer.finish()
    row = (folder / "poses.csv").read_text().splitlines()[1]
    assert row.startswith("0,1700000000.12345")
    assert read_run(folder).times_s[0] == 1_700_000_000.123456


def test_overwriting_removes_the_run_and_nothing_else(folder: Path) -> None:
    with open_writer(folder) as writer:
        writer.append(measurement(0))
        writer.finish()
    (folder / "mine.txt").write_text("keep")
    with open_writer(folder, overwrite=True) as writer:
        writer.begin()
        assert read_run(folder).poses.num_rows == 0
        writer.finish()
    assert (folder / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("option", ["overwrite", "resume"])
def test_a_foreign_folder_is_left_alone(folder: Path, option: str) -> None:
    folder.mkdir()
    (folder / "poses.csv").write_text("precious")
    with pytest.raises(RunError, match="no run"):
        open_writer(folder, **{option: True})
    assert [p.name for p in folder.iterdir()] == ["poses.csv"]
    assert (folder / "poses.csv").read_text() == "precious"
    (folder.parent / "file").write_text("x")
    with pytest.raises(RunError, match="is a file: choose a new folder"):
        open_writer(folder.parent / "file")


def test_resume_says_what_would_change_the_numbers(folder: Path) -> None:
    with open_writer(folder) as writer:
        writer.finish()
    other = dataclasses.replace(
        made_from(settings={"detector": {"rays": 128}}, tracking="predictive"),
        session_digest="x",
        plugins={"detector": "hough of triball 0.2"},
    )
    with pytest.raises(RunError) as caught:
        RunWriter(folder, other, [BODY], CAMERAS, resume=True)
    message = str(caught.value)
    for part in (
        "session",
        "profile.settings.detector.rays (64 then, 128 now)",
        "profile.tracking (unset then, predictive now)",
        "plugins.detector (hough of triball 0.1 then, hough of triball 0.2 now)",
    ):
        assert part in message
    assert "calibration" not in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "column", "value", "message"),
    [
        ("poses", "index", 7, "frame sets are missing or out of order"),
        ("poses", "time_s", None, "frame set 1 has no time, or half a pose"),
        ("poses", "qw", None, "frame set 1 has no time, or half a pose"),
        ("poses", "qw", 7.0, "frame set 1 has no time, or half a pose"),
        ("poses", "covariance", None, "a pose has no covariance"),
        ("poses", "covariance", [float("nan")] * 36, "a pose has no covariance"),
        ("balls", "ball", "blue", r"ball 'blue' is not in body.toml \(green, yellow, red\)"),
        ("balls", "x_mm", float("nan"), "a ball has no time or place"),
        ("balls", "covariance_mm2", None, "a ball has no covariance"),
        ("balls", "covariance_mm2", [None] * 9, "a ball has no covariance"),
        ("poses", "status", "oj", r"status 'oj' is not known \(ok, flagged, lost, skipped\)"),
        ("poses", "balls", ["purple"], r"balls 'purple' is not in body.toml \(green, yellow, red"),
        ("poses", "flags", [None], "flags None is not a text"),
        ("balls", "cameras", ["cam9"], r"cameras 'cam9' is not in calibration.toml \(cam0, cam1"),
        ("balls", "index", 3, "frame sets are out of order"),
        ("detections", "index", 10**6, "frame sets are out of order"),
        (
            "detections",
            "state",
            "efective",
            r"state 'efective' is not known \(effective, suspended",
        ),
        ("detections", "reason", "nonsense", "reason 'nonsense' is not known"),
        ("detections", "index", -1, "frame sets count from 0"),
        ("detections", "ball", None, "ball None is not in body.toml"),
        ("detections", "camera", "cam9", r"camera 'cam9' is not in calibration.toml \(cam0, cam1"),
    ],
)
def test_rows_that_a_run_never_writes(
    folder: Path, name: str, column: str, value: object, message: str
) -> None:
    go_on(folder, 4)
    assert len(read_run(folder).poses) == 4
    path = folder / f"{name}.parquet"
    table = pq.read_table(path)
    cells = table[column].to_pylist()
    cells[1] = value
    field = table.schema.get_field_index(column)
    pq.write_table(
        table.set_column(field, column, pa.array(cells, table.schema.field(field).type)), path
    )
    with pytest.raises(RunError, match=f"{folder}: the {name} are damaged: {message}"):
        read_run(folder)


def test_a_column_by_another_name_is_not_taken_for_an_empty_one(folder: Path) -> None:
    go_on(folder, 4)
    path = folder / "detections.parquet"
    table = pq.read_table(path)
    pq.write_table(table.rename_columns({"u_px": "u", "v_px": "v"}), path)
    with pytest.raises(RunError, match=r"detections.parquet: cannot be read .*column u_px, v_px"):
        read_run(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("session = 3", "'session': input should be a valid dictionary"),
        ("[session]\nnotes = 3", "'session.notes': input should be a valid list, got 3"),
        ("[session]\npath = 3", "'session.path': input should be a valid string, got 3"),
        ("[run]\nstarted = 'noon'", "'run.started': value error, Invalid isoformat string"),
    ],
)
def test_a_run_file_that_a_run_never_writes(folder: Path, text: str, message: str) -> None:
    go_on(folder, 1)
    (folder / "run.toml").write_text(text)
    with pytest.raises(RunError, match=rf"run.toml: {message}"):
        read_run(folder)


def test_nothing_is_touched_before_the_run_begins(folder: Path) -> None:
    with open_writer(folder):
        assert not folder.exists()
    with open_writer(folder) as writer:
        writer.append(measurement(0))
        writer.finish()
    files = sorted(path.name for path in folder.iterdir())
    for option in ("overwrite", "resume"):
        with open_writer(folder, **{option: True}):
            check_whole(folder, 1)
        assert sorted(path.name for path in folder.iterdir()) == files


def test_a_folder_that_may_not_be_written_is_refused_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before hot loops are compiled, and the first picture is measured."""
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(RunError, match=r"cannot write \(Permission denied\); nothing was begun"):
        open_writer(folder)


@pytest.mark.parametrize("options", [{}, {"resume": True}])
def test_run_begun_by_another_process_is_left_alone(folder: Path, options) -> None:
    late = open_writer(folder, **options)
    with open_writer(folder) as first:
        first.append(measurement(0))
        with pytest.raises(RunError, match=f"is being written by process {os.getpid()} on "):
            late.__enter__()
        first.append(measurement(1))
        first.finish()
    check_whole(folder, 2)
