"""A run that is resumed: what is kept of it, what is refused, and who may write."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from measure.errors import RunError
from measure.results import journal, read_run
from measure.results.folder import FolderLock, check_run_folder
from measure.results.tables import SCHEMAS
from tests.results.conftest import (
    PERIOD_S,
    check_whole,
    frames_of,
    go_on,
    measurement,
    open_writer,
    true_pose,
)


def begun(folder: Path, count: int) -> None:
    """A run that ended without its end."""
    with open_writer(folder) as writer:
        writer.begin()
        for i in range(count):
            writer.append(measurement(i))
            writer._flush()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_rows_that_are_kept_stay_and_others_follow(folder: Path) -> None:
    """Also while it is interrupted again; rows of `poses.csv` that no table had are cut."""
    begun(folder, 6)
    with (folder / "poses.csv").open("ab") as file:
        file.write(b"6,of a row that its table had not yet\n")
    before = contents(folder)
    with open_writer(folder, resume=True) as writer:
        assert writer.kept == 6
        assert len(writer.kept_runs[0].poses) == 6
    assert contents(folder) == before, "nothing was begun"
    with open_writer(folder, resume=True) as writer:
        writer.append(measurement(6, error=np.full(6, 0.1)))
    assert frames_of(folder) == list(range(7))
    assert len((folder / "poses.csv").read_text().splitlines()) == 8
    assert go_on(folder, 9) == 7
    check_whole(folder, 9)
    off_mm = read_run(folder).poses["x_mm"].to_numpy()[6] - true_pose(6 * PERIOD_S).translation[0]
    assert off_mm == pytest.approx(0.1), "it was not measured again"


@pytest.mark.parametrize("missing", [["body.toml"], ["body.toml", "calibration.toml"], ["all"]])
def test_a_run_that_was_only_begun_is_gone_on_with(folder: Path, missing: list[str]) -> None:
    begun(folder, 0)
    for path in folder.iterdir():
        if path.name in missing or (missing == ["all"] and path.name != "run.toml"):
            path.unlink()
    assert go_on(folder, 3) == 0
    check_whole(folder, 3)


@pytest.mark.parametrize("left", [(), ("run.lock",), ("run.lock", "run.toml.new")])
@pytest.mark.parametrize("resume", [False, True])
def test_what_is_left_before_a_run_is_begun_is_no_obstacle(
    folder: Path, left: tuple[str, ...], resume: bool
) -> None:
    folder.mkdir()
    for name in left:
        (folder / name).write_text("[run")
    with open_writer(folder, resume=resume) as writer:
        writer.append(measurement(0))
        writer.finish()
    check_whole(folder, 1)
    assert not {"run.lock", "run.toml.new"} & {path.name for path in folder.iterdir()}


def test_whoever_reads_an_unfinished_run_is_told(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    begun(folder, 3)
    read_run(folder)
    assert f"{folder} is not finished: this is of the 3 frame sets it has so far" in caplog.text
    caplog.clear()
    assert go_on(folder, 4) == 3
    read_run(folder)
    assert not caplog.text


def test_streams_of_different_length_and_a_damaged_body_are_mended(folder: Path) -> None:
    begun(folder, 6)
    for name, cut in (("detections", 3000), ("balls", 1500), ("poses", 7)):
        path = folder / f"{name}.arrows"
        path.write_bytes(path.read_bytes()[:-cut])
    (folder / "body.toml").write_text("[[balls")
    assert go_on(folder, 8) == 4
    check_whole(folder, 8)
    assert read_run(folder).body.names == ("green", "yellow", "red")


@pytest.mark.parametrize("rest", [b"\0", b"green"], ids=["zeros", "words"])
@pytest.mark.parametrize("table", SCHEMAS)
@pytest.mark.parametrize("lost", [100, 900, 4096])
def test_an_end_that_a_power_cut_left_is_gone_on_without(
    folder: Path, table: str, lost: int, rest: bytes
) -> None:
    """Rows of zeros, or of what was on the disk before, are none; others go with them."""
    begun(folder, 6)
    before, path = folder.with_name("before"), folder / f"{table}.arrows"
    shutil.copytree(folder, before)
    data = path.read_bytes()
    path.write_bytes(data[:-lost] + (rest * lost)[:lost])
    kept = frames_of(folder)
    assert kept == list(range(len(kept)))
    # The last hundred bytes may be zeros as they should be: then nothing was lost.
    assert len(kept) < 6 or path.read_bytes() == data
    cut, whole = read_run(folder), read_run(before)
    for name in SCHEMAS:
        rows = getattr(whole, name)
        same = rows.filter(pa.compute.less(rows["index"], len(kept)))
        assert str(getattr(cut, name).to_pylist()) == str(same.to_pylist())
    assert go_on(folder, 8) == len(kept)
    check_whole(folder, 8)


_HOLDER = """
    import sys, time
    from pathlib import Path
    from measure.results.folder import FolderLock
    lock = FolderLock(Path(sys.argv[1]))
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_lock_ends_with_its_process_even_if_that_is_killed(folder: Path) -> None:
    folder.mkdir()
    command = [sys.executable, "-c", textwrap.dedent(_HOLDER), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout.readline() == "held\n"
            for refused in (open_writer, partial(check_run_folder, resume=True, overwrite=False)):
                with pytest.raises(RunError) as caught:
                    refused(folder)
                said = str(caught.value)
                assert f"{folder} is being written by process {holder.pid} on " in said
                assert "\n" not in said
        finally:
            holder.send_signal(signal.SIGKILL)
    assert (folder / "run.lock").exists()
    check_run_folder(folder, True, False)
    with open_writer(folder) as writer:
        told = json.loads((folder / "run.lock").read_text())
        assert told["pid"] == os.getpid()
        writer.finish()
    assert not (folder / "run.lock").exists()


def test_a_lock_that_was_released_while_another_waited_for_it_is_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file is gone: who locks it all the same must begin again, with the new one."""
    folder.mkdir()
    first = FolderLock(folder)
    opened = os.open

    def open_then_release(*args: object) -> int:
        descriptor = opened(*args)
        first.release()
        return descriptor

    monkeypatch.setattr("os.open", open_then_release)
    second = FolderLock(folder)
    monkeypatch.undo()
    with pytest.raises(RunError, match="is being written"):
        FolderLock(folder)
    second.release()
    FolderLock(folder).release()


def test_a_file_system_without_locks_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsupported(*_: object, **__: object) -> bool:
        raise OSError(37, os.strerror(37))

    monkeypatch.setattr("measure.results.folder.lock_descriptor", unsupported)
    with pytest.raises(RunError, match="its file system cannot lock files"):
        begun(folder, 1)
    assert not (folder / "run.toml").exists()


def test_a_run_can_be_read_at_any_moment_of_its_writing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the reading of two tables more is written, and the run is finished."""
    with open_writer(folder) as writer:
        for i in range(3):
            writer.append(measurement(i))
        writer._flush()
        opened, more = pa.ipc.open_stream, iter(range(3, 5))

        def open_then_write(file: object) -> object:
            table = opened(file)
            if (i := next(more, None)) is not None:
                writer.append(measurement(i))
                writer._flush()
            return table

        monkeypatch.setattr(pa.ipc, "open_stream", open_then_write)
        run = read_run(folder)
        monkeypatch.undo()
        counts = np.bincount(run.detections["index"].to_numpy())
        assert counts.tolist() == [9] * len(run.poses)
        assert len(read_run(folder).poses) == 5

        def finish_first(path: Path, schema: pa.Schema) -> pa.Table:
            monkeypatch.undo()
            writer.finish()
            return journal._whole_batches(path, schema)

        monkeypatch.setattr(journal, "_whole_batches", finish_first)
        assert frames_of(folder) == list(range(5))
