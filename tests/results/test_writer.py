"""Kills, tears and full disks, struck wherever it hurts."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from measure.errors import RunError
from measure.results import RunWriter, read_run
from tests.results.conftest import BODY, CAMERAS, made_from, measurement


def _writer(folder: Path, **options: bool) -> RunWriter:
    return RunWriter(folder, made_from(), BODY, CAMERAS, **options)


def _go_on(folder: Path, count: int) -> int:
    """Resume and finish with `count` frame sets in all; returns where it went on."""
    with _writer(folder, resume=True) as writer:
        start = writer.next_index
        for i in range(start, count):
            writer.append(measurement(i))
        writer.finish()
    return start


def _frames(folder: Path) -> list[int]:
    return read_run(folder).poses["index"].to_pylist()


def _check_whole(folder: Path, count: int) -> None:
    """Every table and poses.csv hold every frame set once."""
    run = read_run(folder)
    assert run.finished
    assert _frames(folder) == list(range(count))
    assert np.bincount(run.detections["index"].to_numpy()).tolist() == [9] * count
    assert np.bincount(run.balls["index"].to_numpy()).tolist() == [3] * count
    rows = (folder / "poses.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == list(range(count))
    assert not list(folder.glob("*.arrows"))


def test_times_from_1970_keep_their_nanoseconds(folder: Path) -> None:
    with _writer(folder) as writer:
        writer.append(dataclasses.replace(measurement(0), time_s=1_700_000_000.123456))
        writer.finish()
    row = (folder / "poses.csv").read_text().splitlines()[1]
    assert row.startswith("0,1700000000.12345")
    assert read_run(folder).times_s[0] == 1_700_000_000.123456


_KILLED = """
    import os, signal, sys, time
    from pathlib import Path
    from measure.results import RunWriter
    from tests.results.conftest import BODY, CAMERAS, made_from, measurement
    writer = RunWriter(Path(sys.argv[1]), made_from(), BODY, CAMERAS)
    started = time.monotonic()
    late = None
    for i in range(10_000):
        writer.append(measurement(i))
        now = time.monotonic() - started
        if late is None and now > 0.8:
            late = i
        if now > 1.8:
            print(late, i + 1, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.01)
"""


def test_a_kill_costs_at_most_the_last_second(folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(_KILLED), str(folder)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    second_before, count = map(int, done.stdout.split())
    assert not read_run(folder).finished
    assert not (folder / "summary.json").exists()
    assert len((folder / "poses.csv").read_text().splitlines()) == count + 1
    kept = _frames(folder)
    assert kept == list(range(len(kept)))
    assert len(kept) >= second_before
    assert _go_on(folder, count + 5) == len(kept)
    _check_whole(folder, count + 5)


@pytest.mark.parametrize("cut", [1, 7, 40, 300])
@pytest.mark.parametrize("torn", [("detections", "balls", "poses"), ("poses",), ("detections",)])
def test_a_torn_batch_is_dropped(folder: Path, torn: tuple[str, ...], cut: int) -> None:
    with _writer(folder) as writer:
        for i in range(3):
            writer.append(measurement(i))
            writer._flush()
    for table in torn:
        path = folder / f"{table}.arrows"
        path.write_bytes(path.read_bytes()[:-cut])
    assert set(read_run(folder).detections["index"].to_pylist()) <= set(_frames(folder))
    if "poses" in torn:
        assert _frames(folder) == [0, 1]
        assert _go_on(folder, 3) == 2
        _check_whole(folder, 3)


def test_an_interrupt_keeps_everything(folder: Path) -> None:
    def interrupted() -> None:
        with _writer(folder) as writer:
            for i in range(5):
                writer.append(measurement(i))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert _frames(folder) == list(range(5))
    assert not read_run(folder).finished
    assert _go_on(folder, 8) == 5
    _check_whole(folder, 8)


def test_a_finished_run_can_be_gone_on_with(folder: Path) -> None:
    with _writer(folder) as writer:
        writer.finish()
    assert _go_on(folder, 4) == 0
    assert _go_on(folder, 6) == 4
    _check_whole(folder, 6)


def test_overwriting_removes_the_run_and_nothing_else(folder: Path) -> None:
    with _writer(folder) as writer:
        writer.append(measurement(0))
        writer.finish()
    (folder / "mine.txt").write_text("keep")
    with _writer(folder, overwrite=True) as writer:
        assert read_run(folder).poses.num_rows == 0
        writer.finish()
    assert (folder / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("option", ["overwrite", "resume"])
def test_a_foreign_folder_is_left_alone(folder: Path, option: str) -> None:
    folder.mkdir()
    (folder / "poses.csv").write_text("precious")
    with pytest.raises(RunError, match="no run"):
        _writer(folder, **{option: True})
    assert [p.name for p in folder.iterdir()] == ["poses.csv"]
    assert (folder / "poses.csv").read_text() == "precious"
    (folder.parent / "file").write_text("x")
    with pytest.raises(RunError, match="is a file: choose a new folder"):
        _writer(folder.parent / "file")


def test_resume_says_what_would_change_the_numbers(folder: Path) -> None:
    with _writer(folder) as writer:
        writer.finish()
    other = dataclasses.replace(
        made_from(settings={"detector": {"rays": 128}}, tracking="predictive"),
        session_digest="x",
        plugins={"detector": "hough of triball 0.2"},
    )
    with pytest.raises(RunError) as caught:
        RunWriter(folder, other, BODY, CAMERAS, resume=True)
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


@pytest.fixture
def small_disk(tmp_path: Path):
    """A real file system of 320 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=320k", "tmpfs", str(place)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("may not mount a tmpfs here")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def _fill(writer: RunWriter, done: list[int]) -> None:
    with writer:
        for i in range(5000):
            writer.append(measurement(i))
            writer._flush_all()
            done.append(i)


class _Flushing(RunWriter):
    """Writes everything at once, so that the test knows what must be there."""

    def _flush_all(self) -> None:
        from measure.results.journal import writing

        with writing(self._folder):
            self._flush()


def test_a_full_disk_loses_nothing_written_before(small_disk: Path) -> None:
    folder = small_disk / "run"
    done: list[int] = []
    with pytest.raises(RunError) as caught:
        _fill(_Flushing(folder, made_from(), BODY, CAMERAS), done)
    assert "the disk is full; everything measured before is kept" in str(caught.value)
    assert "--resume" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(done) > 3
    assert _frames(folder) == done
    text = (folder / "poses.csv").read_text()
    assert text.endswith("\n")
    assert text.count("\n") in (len(done) + 1, len(done) + 2)


class _FullAfter:
    """A file that takes so many bytes, then has no space; half of a write may still go in."""

    def __init__(self, inner, room: list[int]) -> None:
        self.inner, self.room = inner, room

    def write(self, data: bytes) -> int:
        if self.room[0] <= 0:
            raise OSError(28, os.strerror(28))
        fits = data[: self.room[0]]
        self.room[0] -= len(fits)
        return self.inner.write(fits)

    def __getattr__(self, name: str):
        return getattr(self.inner, name)


@pytest.mark.parametrize("room", [0, 500, 5_000, 20_001, 50_123])
def test_a_full_disk_wherever_it_strikes(folder: Path, room: int) -> None:
    writer = _Flushing(folder, made_from(), BODY, CAMERAS)
    left = [room]
    for file in (*(journal._file for journal in writer._journals.values()), writer._csv):
        file._file = _FullAfter(file._file, left)
    done: list[int] = []
    with pytest.raises(RunError, match="the disk is full"):
        _fill(writer, done)
    assert _frames(folder) == done
    assert _go_on(folder, len(done) + 3) == len(done)
    _check_whole(folder, len(done) + 3)


def test_a_disk_full_at_the_very_end_keeps_the_journals(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet as pq

    def full(*_: object, **__: object) -> None:
        raise OSError(28, os.strerror(28))

    def write() -> None:
        with _writer(folder) as writer:
            for i in range(4):
                writer.append(measurement(i))
            monkeypatch.setattr(pq, "write_table", full)
            writer.finish()

    with pytest.raises(RunError, match="the disk is full"):
        write()
    monkeypatch.undo()
    assert not read_run(folder).finished
    assert _go_on(folder, 4) == 4
    _check_whole(folder, 4)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("index", 7, "frame sets are missing or out of order"),
        ("time_s", None, "frame set 1 has no time, or half a pose"),
        ("qw", None, "frame set 1 has no time, or half a pose"),
        ("qw", 7.0, "frame set 1 has no time, or half a pose"),
        ("covariance", None, "a pose has no covariance"),
    ],
)
def test_poses_that_a_run_never_writes(
    folder: Path, column: str, value: float | None, message: str
) -> None:
    _go_on(folder, 4)
    assert len(read_run(folder).poses) == 4
    path = folder / "poses.parquet"
    table = pq.read_table(path)
    cells = table[column].to_pylist()
    cells[1] = value
    field = table.schema.get_field_index(column)
    pq.write_table(
        table.set_column(field, column, pa.array(cells, table.schema.field(field).type)), path
    )
    with pytest.raises(RunError, match=f"{folder}: the poses are damaged: {message}"):
        read_run(folder)
