"""A run folder holds what was measured, whatever happens to the program."""

from __future__ import annotations

import csv
import dataclasses
import errno
import os
import signal
import subprocess
import sys
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.errors import RunError
from measure.results import Provenance, RunWriter, read_run
from measure.results import journal as journal_module

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
    with RunWriter(folder, PROVENANCE, BODY, CAMERAS, **options) as writer:
        for index in range(writer.next_index, total):
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


def test_a_kill_loses_at_most_one_batch_and_resuming_completes_the_run(tmp_path):
    folder = tmp_path / "run"
    program = (
        "import sys, time; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path\n"
        "from results.test_run_folder import PROVENANCE, BODY, CAMERAS, RunWriter, measurement\n"
        "writer = RunWriter(Path(sys.argv[1]), PROVENANCE, BODY, CAMERAS)\n"
        "for index in range(37):\n"
        "    time.sleep(0.03); writer.append(measurement(index, lost=index == 3))\n"
        "print('written', flush=True); time.sleep(60)\n"
    )
    tests = Path(__file__).resolve().parents[1]
    with subprocess.Popen(
        [sys.executable, "-c", program, folder, tests], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    partial = read_run(folder)
    assert not partial.finished
    assert partial.poses.num_rows >= 20
    _write(folder, 50, resume=True)
    _write(tmp_path / "whole", 50)
    for name in ("poses", "balls", "detections"):
        resumed = getattr(read_run(folder), name).to_pylist()
        assert str(resumed) == str(getattr(read_run(tmp_path / "whole"), name).to_pylist())
    assert (folder / "poses.csv").read_text() == (tmp_path / "whole/poses.csv").read_text()


def test_a_torn_stream_is_read_up_to_the_tear(tmp_path):
    folder = tmp_path / "run"
    with RunWriter(folder, PROVENANCE, BODY, CAMERAS, clock=count().__next__) as writer:
        for index in range(30):
            writer.append(measurement(index))
    stream = folder / "poses.arrows"
    stream.write_bytes(stream.read_bytes()[:-700])
    assert 0 < read_run(folder).poses.num_rows < 30
    _write(folder, 30, resume=True)
    assert read_run(folder).detections.num_rows == 30 * 6


def _write_until_full(folder, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunWriter(folder, PROVENANCE, BODY, CAMERAS, clock=count().__next__) as writer:
        for index in range(40):
            if index == 20:
                monkeypatch.setattr(journal_module.Journal, "flush", full)
            writer.append(measurement(index))


def test_disk_full_loses_nothing_written_before(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    with pytest.raises(RunError, match=r"the disk is full.*--resume"):
        _write_until_full(folder, monkeypatch)
    monkeypatch.undo()
    assert read_run(folder).poses.num_rows == 20
    _write(folder, 40, resume=True)
    assert read_run(folder).poses.num_rows == 40


def test_a_run_is_never_overwritten_unasked(tmp_path):
    _write(tmp_path / "run", 5)
    with pytest.raises(RunError, match="--resume"):
        _write(tmp_path / "run", 5)
    assert _write(tmp_path / "run", 7, overwrite=True).frame_sets == 7


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match="no run"):
        _write(tmp_path, 5, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()


def test_resuming_with_another_setting_is_refused(tmp_path):
    _write(tmp_path / "run", 5)
    changed = dataclasses.replace(PROVENANCE, profile={**PROVENANCE.profile, "detector": "hough"})
    with pytest.raises(RunError, match=r"profile\.detector"):
        RunWriter(tmp_path / "run", changed, BODY, CAMERAS, resume=True)


@pytest.mark.parametrize(("make", "said"), [(False, "no such folder"), (True, "no run.toml")])
def test_what_is_no_run_is_refused(tmp_path, make, said):
    if make:
        (tmp_path / "x").mkdir()
    with pytest.raises(RunError, match=said):
        read_run(tmp_path / "x")
