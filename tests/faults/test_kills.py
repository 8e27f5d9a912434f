"""Runs that are killed and resumed, two writers of one folder; the long part is `kills.rows`."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import pytest

from measure.results.kept import csv_rows
from tests.faults.killed import Ended, Moment, Process
from tests.faults.kills import Case, Uninterrupted, killed_and_resumed, second_writers
from tests.results.conftest import measurement, open_writer

SETS = 4


def write(folder: Path, resume: bool) -> int:
    """Write a run whose measurements cost no time."""
    with open_writer(folder, resume=resume) as writer:
        for k in range(SETS):
            writer.append(measurement(k, lost=k == 2))
            if k == 1:
                writer._flush()
        writer.finish()
    return 0


def written(folder: Path, resume: bool, moment: Moment | None) -> Ended:
    return Process(write, (folder, resume), folder, moment).end()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "run.toml"}


def test_a_kill_at_any_step_costs_nothing(tmp_path: Path) -> None:
    """At every other step a further one while resuming."""
    whole, rng = written(tmp_path / "whole", False, None), random.Random(1)
    assert whole.code == 0, whole.said
    # A kill before an unnecessary removal is one after it.
    steps = [k for k, step in enumerate(whole.steps) if not step.startswith("os.remove")]
    for step in steps:
        folder = tmp_path / f"killed{step}"
        assert written(folder, False, Moment(step)).code == -signal.SIGKILL
        rows = csv_rows(folder / "poses.csv")
        assert rows == max(sum(one.startswith("row") for one in whole.steps[:step]) - 1, 0)
        if step % 2:
            again = written(folder, True, Moment(rng.choice(steps)))
            assert again.code in (0, -signal.SIGKILL), again.said
            assert csv_rows(folder / "poses.csv") >= rows
        last = written(folder, True, None)
        assert last.code == 0, last.said
        assert contents(folder) == contents(tmp_path / "whole"), whole.steps[step]


@pytest.fixture(scope="module", params=["precise", "paper"])
def whole(request: pytest.FixtureRequest, still: Path, tmp_path_factory) -> Uninterrupted:
    """A rendered session measured undisturbed."""
    folder = tmp_path_factory.mktemp("kills")
    return Uninterrupted.of(Case("still", still, request.param), folder / "whole")


@pytest.mark.slow
def test_killed_twice_a_run_equals_the_uninterrupted_one(
    whole: Uninterrupted, tmp_path: Path
) -> None:
    """To the byte, whatever trackers and detectors had learnt by then."""
    stages = whole.stages()
    measuring, closing = stages["measuring"], stages["closing"]
    moments = [Moment(measuring[7], 0.005), Moment(closing[len(closing) // 2])]
    outcome = killed_and_resumed(whole, tmp_path / "run", moments)
    assert not outcome.refused
    assert not outcome.differing
    assert outcome.rows_lost == 0
    some = tmp_path / "run" / "poses.csv"
    some.write_bytes(some.read_bytes().replace(b"1", b"2", 1))
    assert whole.differs_from(tmp_path / "run") == ["poses.csv"], "a digit is a difference"


@pytest.mark.slow
@pytest.mark.parametrize("whole", ["paper"], indirect=True)
def test_a_second_writer_is_refused_and_readers_are_not(
    whole: Uninterrupted, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    step = whole.stages()["measuring"][5]
    others, first = second_writers(whole.case, out, step)
    reader = others.pop("evaluate")
    assert reader.code == 0, reader.said
    for name, ended in others.items():
        assert ended.code == 2, name
        assert ended.said.count("\n") == 1, ended.said
        assert f"{out} is being written by process " in ended.said
        assert "wait for its end, or choose another folder with --out" in ended.said
    assert first.code == 0, first.said
    assert not whole.differs_from(out)
