"""A run folder holds what was measured; what a run never writes is refused."""

from __future__ import annotations

import csv
import dataclasses
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from measure.errors import RunError
from measure.model import Doubt
from measure.results import RunWriter, journal, read_run
from measure.results.tables import SCHEMAS, doubts_of
from tests.results.conftest import (
    BODY,
    CAMERAS,
    PERIOD_S,
    check_whole,
    go_on,
    made_from,
    measurement,
    open_writer,
    true_pose,
    written,
)


def test_times_from_1970_keep_their_nanoseconds(folder: Path) -> None:
    run = written(folder, [dataclasses.replace(measurement(0), time_s=1_700_000_000.123456)])
    row = (folder / "poses.csv").read_text().splitlines()[1]
    assert row.startswith("0,1700000000.12345")
    assert run.times_s[0] == 1_700_000_000.123456


def test_overwriting_removes_the_run_and_nothing_else(folder: Path) -> None:
    written(folder, [measurement(0)])
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


def test_resume_says_what_would_change_the_numbers(folder: Path) -> None:
    written(folder, [])
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
        ("poses", "doubts", [None], "doubts None is not a text"),
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
        ("[[session.findings]]\nlevel = 'bad'", "'session.findings.0.level': input should"),
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
    written(folder, [measurement(0)])
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


def test_what_was_measured_is_read_back(tmp_path):
    run = written(tmp_path / "run", [measurement(i, lost=i == 3) for i in range(25)])
    summary = run.summary
    assert run.finished
    assert (summary.frame_sets, summary.ok, summary.lost) == (25, 24, 1)
    assert summary.effective["red@cam1"] == 24 / 25
    assert not run.has_pose[3]
    expected = measurement(10).pose
    place = run.world_from_body[9]
    assert place.difference(expected.world_from_body) == pytest.approx(np.zeros(6), abs=1e-12)
    assert run.covariances[9] == pytest.approx(expected.covariance)
    assert run.body.names == BODY.names
    assert [camera.name for camera in run.cameras] == ["cam0", "cam1", "cam2"]


def test_csv_has_a_row_for_every_frame_set(tmp_path):
    written(tmp_path / "run", [measurement(i, lost=i == 3) for i in range(6)])
    with (tmp_path / "run/poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == list("012345")
    assert rows[3]["x_mm"] == ""
    assert rows[3]["status"] == "lost"
    assert float(rows[4]["x_mm"]) == pytest.approx(true_pose(4 * PERIOD_S).translation[0])
    assert rows[4]["cameras"] == "cam0 cam1 cam2"
    needed = "frame,time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz,position_sd_mm,rms_px,cameras,status"
    assert set(needed.split(",")) <= set(rows[0])


def test_frame_numbers_in_microseconds_survive(tmp_path):
    frames = dict.fromkeys(("cam0", "cam1", "cam2"), 1_700_000_000_123_456)
    with open_writer(tmp_path / "run") as writer:
        writer.append(dataclasses.replace(measurement(0), frames=frames))
        writer._flush()
        assert set(read_run(tmp_path / "run").detections["frame"].to_pylist()) == {*frames.values()}
        writer.finish()
    assert set(read_run(tmp_path / "run").detections["frame"].to_pylist()) == {*frames.values()}


def test_a_folder_whose_name_is_no_text_can_be_written_and_read(tmp_path):
    folder = tmp_path / os.fsdecode(b"r\xff")
    assert written(folder, map(measurement, range(2))).poses.num_rows == 2


def test_no_thread_may_hold_a_file_of_pythons_after_its_end(tmp_path, monkeypatch):
    """One that let go of it while Python ended aborted the process, one time in twenty."""
    really, held = journal.pq.read_table, []

    def read(file, **how):
        held.append(file)
        return really(file, **how)

    written(tmp_path / "run", map(measurement, range(4)))
    monkeypatch.setattr(journal.pq, "read_table", read)
    read_run(tmp_path / "run")
    assert len(held) == 3
    assert all(isinstance(file, pa.NativeFile) for file in held)


@pytest.mark.parametrize("ended", [True, False])
def test_a_run_without_codes_shows_its_reasons_and_is_gone_on_with(folder, ended):
    """As version 0.2.0 wrote it; before, frames were 32-bit numbers."""
    with open_writer(folder) as writer:
        writer.append(measurement(0).flagged("too dark", Doubt("two-balls")))
        if ended:
            writer.finish()
    for name in ("poses", "detections"):
        file = folder / (f"{name}.parquet" if ended else f"{name}.arrows")
        table = pq.read_table(file) if ended else pa.ipc.open_stream(file.read_bytes()).read_all()
        table = table.drop_columns([n for n in table.column_names if n == "doubts"])
        schema = pa.schema(
            [f.with_type(pa.int32()) if f.name == "frame" else f for f in table.schema]
        )
        with pq.ParquetWriter(file, schema) if ended else pa.ipc.new_stream(file, schema) as out:
            out.write_table(table.cast(schema))
    old = {"too dark; fewer than three balls in sight": 1}
    assert read_run(folder).summary.reasons == old
    assert read_run(folder).detections.schema == SCHEMAS["detections"]
    with open_writer(folder, resume=True) as writer:
        writer.append(measurement(1).flagged(Doubt("two-balls")))
        assert writer.finish().reasons == old | {"fewer than three balls in sight": 1}
    assert (folder / "poses.csv").read_text().endswith("three balls in sight,two-balls\n")
    (_, (doubt,)) = doubts_of(read_run(folder).poses)
    assert doubt.plain == {"code": "two-balls"}


@pytest.mark.parametrize("stream", [True, False])
def test_a_table_with_a_column_twice_is_damaged(tmp_path, stream):
    written(tmp_path / "run", map(measurement, range(2)))
    file = tmp_path / "run/poses.parquet"
    table = pq.read_table(file)
    twice = table.append_column("x_mm", table["x_mm"])
    if stream:
        file.unlink()
        content = file.with_suffix(".arrows").open("wb")
        with content, pa.ipc.new_stream(content, twice.schema) as out:
            out.write_table(twice)
    else:
        pq.write_table(twice, file)
    with pytest.raises(RunError, match=r"cannot be read .*column x_mm is there twice"):
        read_run(tmp_path / "run")
