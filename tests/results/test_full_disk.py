"""Full disks, struck wherever it hurts: nothing written before is lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from measure.errors import RunError
from measure.results import RunWriter, read_run
from tests.results import conftest


def _fill(writer: RunWriter, done: list[int]) -> None:
    with writer:
        for i in range(5000):
            writer.append(conftest.measurement(i))
            writer._flush_all()
            done.append(i)


class _Flushing(RunWriter):
    """Writes everything at once, so that the test knows what must be there."""

    def _flush_all(self) -> None:
        from measure.results.journal import writing

        with writing(self._folder):
            self._flush()


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
    class OnSmallDisk(_Flushing):
        def begin(self):
            if self._begun:
                return
            super().begin()
            left = [room]
            for file in (*self._journals.values(), *self._csv.values()):
                file._file = _FullAfter(file._file, left)

    writer = OnSmallDisk(folder, conftest.made_from(), [conftest.BODY], conftest.CAMERAS)
    done: list[int] = []
    with pytest.raises(RunError, match="the disk is full"):
        _fill(writer, done)
    assert conftest.frames_of(folder) == done
    assert conftest.go_on(folder, len(done) + 3) == len(done)
    conftest.check_whole(folder, len(done) + 3)


def test_a_disk_full_at_the_very_end_keeps_the_journals(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet as pq

    def full(*_: object, **__: object) -> None:
        raise OSError(28, os.strerror(28))

    def write() -> None:
        with conftest.open_writer(folder) as writer:
            for i in range(4):
                writer.append(conftest.measurement(i))
            monkeypatch.setattr(pq, "write_table", full)
            writer.finish()

    with pytest.raises(RunError, match="the disk is full"):
        write()
    monkeypatch.undo()
    assert not read_run(folder).finished
    assert conftest.go_on(folder, 4) == 4
    conftest.check_whole(folder, 4)
