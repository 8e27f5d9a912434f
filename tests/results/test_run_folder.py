"""A run folder holds what was measured. Kills, tears and full disks: `test_writer.py`."""

from __future__ import annotations

import csv
import os
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from measurements import BODY, CAMERAS, measurement
from pyarrow import parquet

from measure.errors import RunError
from measure.results import Provenance, RunWriter, journal, read_run
from measure.results.tables import SCHEMAS

PROVENANCE = Provenance(
    session="/data/session",
    session_digest="a",
    calibration="calibration.toml",
    calibration_digest="b",
    body_digest="c",
    profile={"name": "precise", "detector": {"name": "outline", "rays": 64}},
    plugins={"detector": "outline of triball 0.1.0"},
)


def _write(folder, total, **options):
    with RunWriter(folder, PROVENANCE, [BODY], CAMERAS, **options) as writer:
        for index in range(writer.kept, total):
            writer.append(measurement(index, lost=index == 3))
        return writer.finish()


def test_what_was_measured_is_read_back(tmp_path):
    summary = _write(tmp_path / "run", 25)
    run = read_run(tmp_path / "run")
    assert run.finished
    assert run.summary == summary
    assert (summary.frame_sets, summary.ok, summary.lost) == (25, 24, 1)
    assert summary.effective["red@cam1"] == 1.0
    assert not run.has_pose[3]
    expected = measurement(10).pose
    place = run.world_from_body[9]
    assert place.difference(expected.world_from_body) == pytest.approx(np.zeros(6), abs=1e-12)
    assert run.covariances[9] == pytest.approx(expected.covariance)
    assert run.body.names == BODY.names
    assert [camera.name for camera in run.cameras] == ["cam0", "cam1"]


def test_csv_has_a_row_for_every_frame_set(tmp_path):
    _write(tmp_path / "run", 6)
    with (tmp_path / "run/poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == list("012345")
    assert rows[3]["x_mm"] == ""
    assert rows[3]["status"] == "lost"
    assert float(rows[4]["x_mm"]) == pytest.approx(0.4)
    assert rows[4]["cameras"] == "cam0 cam1"
    needed = "frame,time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz,position_sd_mm,rms_px,cameras,status"
    assert set(needed.split(",")) <= set(rows[0])


def test_frame_numbers_in_microseconds_survive(tmp_path):
    frames = dict.fromkeys(("cam0", "cam1"), 1_700_000_000_123_456)
    with RunWriter(tmp_path / "run", PROVENANCE, [BODY], CAMERAS) as writer:
        writer.append(replace(measurement(0), frames=frames))
        writer._flush()
        assert set(read_run(tmp_path / "run").detections["frame"].to_pylist()) == {*frames.values()}
        writer.finish()
    assert set(read_run(tmp_path / "run").detections["frame"].to_pylist()) == {*frames.values()}


def test_a_folder_whose_name_is_no_text_can_be_written_and_read(tmp_path):
    folder = tmp_path / os.fsdecode(b"r\xff")
    _write(folder, 2)
    assert read_run(folder).poses.num_rows == 2


def test_no_thread_may_hold_a_file_of_pythons_after_its_end(tmp_path, monkeypatch):
    """One that let go of it while Python ended aborted the process, one time in twenty."""
    really, held = journal.pq.read_table, []

    def read(file, **how):
        held.append(file)
        return really(file, **how)

    _write(tmp_path / "run", 4)
    monkeypatch.setattr(journal.pq, "read_table", read)
    read_run(tmp_path / "run")
    assert len(held) == 3
    assert all(isinstance(file, pa.NativeFile) for file in held)


def test_an_unfinished_run_of_an_earlier_version_can_be_read(tmp_path):
    with RunWriter(tmp_path / "run", PROVENANCE, [BODY], CAMERAS) as writer:
        writer.append(measurement(0))
    stream = tmp_path / "run/detections.arrows"
    with stream.open("rb") as file:
        table = pa.ipc.open_stream(file).read_all()
    table = table.set_column(3, "frame", table["frame"].cast(pa.int32()))
    with pa.ipc.new_stream(stream, table.schema) as out:
        out.write_table(table)
    assert read_run(tmp_path / "run").detections.schema == SCHEMAS["detections"]


def test_a_run_is_never_overwritten_unasked(tmp_path):
    _write(tmp_path / "run", 5)
    with pytest.raises(RunError, match="--resume"):
        _write(tmp_path / "run", 5)
    assert _write(tmp_path / "run", 7, overwrite=True).frame_sets == 7


@pytest.mark.parametrize(("make", "said"), [(False, "no such folder"), (True, "no run.toml")])
def test_what_is_no_run_is_refused(tmp_path, make, said):
    if make:
        (tmp_path / "x").mkdir()
    with pytest.raises(RunError, match=said):
        read_run(tmp_path / "x")


@pytest.mark.parametrize("stream", [True, False])
def test_a_table_with_a_column_twice_is_damaged(tmp_path, stream):
    _write(tmp_path / "run", 2)
    file = tmp_path / "run/poses.parquet"
    table = parquet.read_table(file)
    twice = table.append_column("x_mm", table["x_mm"])
    if stream:
        file.unlink()
        content = file.with_suffix(".arrows").open("wb")
        with content, pa.ipc.new_stream(content, twice.schema) as out:
            out.write_table(twice)
    else:
        parquet.write_table(twice, file)
    with pytest.raises(RunError, match=r"cannot be read .*column x_mm is there twice"):
        read_run(tmp_path / "run")
