"""Runs that are killed and resumed, two writers of one folder; the long part is `kills.rows`."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.faults import kills
from benchmarks.faults.killed import Moment
from measure.results.journal import GrowingFile
from tests.results.conftest import measurement, open_writer

SETS = 4


def write(folder: Path, resume: bool) -> None:
    """Write a run whose measurements cost no time."""
    with open_writer(folder, resume=resume) as writer:
        for k in range(writer.kept, SETS):
            writer.append(measurement(k, lost=k == 2))
            if k == 1:
                writer._flush()
        writer.finish()


def killed_at_every_step(folder: Path, resume: bool, kept: Path) -> list[Path]:
    """What kills would leave of `write`: the folder before each step that changes it, copied."""
    left: list[Path] = []
    states = [list[tuple[str, int, int]]()]

    def watched(step: Callable[..., object]) -> Callable[..., object]:
        def watching(*args: object, **options: object) -> object:
            if folder.exists() and (state := sizes(folder)) != states[-1]:
                states.append(state)
                left.append(kept / f"{folder.name}-{len(left)}")
                shutil.copytree(folder, left[-1], copy_function=shutil.copyfile)
            return step(*args, **options)

        return watching

    with pytest.MonkeyPatch.context() as patch:
        for place, name in (
            (Path, "open"),
            (Path, "replace"),
            (Path, "unlink"),
            (GrowingFile, "append"),
        ):
            patch.setattr(place, name, watched(getattr(place, name)))
        write(folder, resume)
    return left


def sizes(folder: Path) -> list[tuple[str, int, int]]:
    with os.scandir(folder) as files:
        return sorted((one.name, one.stat().st_size, one.inode()) for one in files)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "run.toml"}


def test_a_kill_at_any_step_costs_nothing(tmp_path: Path) -> None:
    """Nor does a further one while resuming."""
    whole, rng = tmp_path / "whole", random.Random(1)
    kept = tmp_path / "killed"
    kept.mkdir()
    killed = killed_at_every_step(whole, False, kept)
    assert len({kills.csv_rows(folder / "poses.csv") for folder in killed}) == SETS + 1
    for number, folder in enumerate(killed):
        rows, left = kills.kept_rows(folder), sorted(contents(folder))
        if number % 8:
            write(folder, True)
        else:
            again = killed_at_every_step(folder, True, kept)
            assert all(kills.kept_rows(one) >= rows for one in again)
            second = rng.choice(again)
            write(second, True)
            assert contents(second) == contents(whole), left
        assert contents(folder) == contents(whole), left


@pytest.fixture(scope="module", params=["paper"])
def whole(request: pytest.FixtureRequest, still: Path, tmp_path_factory) -> kills.Uninterrupted:
    """A rendered session measured undisturbed."""
    folder = tmp_path_factory.mktemp("kills")
    return kills.Uninterrupted.of(kills.Case("still", still, request.param), folder / "whole")


@pytest.mark.slow
def test_killed_twice_a_run_equals_the_uninterrupted_one(
    whole: kills.Uninterrupted, tmp_path: Path
) -> None:
    """To the byte, whatever trackers and detectors had learnt by then."""
    stages = whole.stages()
    measuring, closing = stages["measuring"], stages["closing"]
    moments = [Moment(measuring[7], 0.005), Moment(closing[len(closing) // 2])]
    outcome = kills.killed_and_resumed(whole, tmp_path / "run", moments)
    assert not outcome.refused
    assert not outcome.differing
    assert outcome.rows_lost == 0
    some = tmp_path / "run" / "poses.csv"
    some.write_bytes(some.read_bytes().replace(b"1", b"2", 1))
    assert whole.differs_from(tmp_path / "run") == ["poses.csv"], "a digit is a difference"


@pytest.mark.slow
def test_a_second_writer_is_refused_and_readers_are_not(
    whole: kills.Uninterrupted, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    step = whole.stages()["measuring"][5]
    others, first = kills.second_writers(whole.case, out, step)
    reader = others.pop("evaluate")
    # Rows are written for readers twice a second: there may be none yet.
    assert reader.code == 0 or "holds no frame set yet" in reader.said, reader.said
    for name, ended in others.items():
        assert ended.code == 2, name
        assert ended.said.count("\n") == 1, ended.said
        assert f"{out} is being written by process " in ended.said
        assert "wait for its end, or choose another folder with --out" in ended.said
    assert first.code == 0, first.said
    assert not whole.differs_from(out)
