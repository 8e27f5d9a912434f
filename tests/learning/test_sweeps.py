"""Sweeps, as typed: spaces that make sense, and workers that are killed."""

from __future__ import annotations

import json
import multiprocessing
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from measure.cli import main
from measure.errors import DivergedError, EstimatorError
from measure.host import Dataset, Estimator, Registry, quiet
from measure_learning.core import files, sweeping
from measure_learning.core.sweeping import Range, read_space
from tests.dask_cluster import Cluster

pytest.importorskip("torch", reason="training needs the extra 'train'")


SPACE = """
[penalty]
low = 1e-6
high = 1e-1
log = true
[features]
choices = ["pose", "play"]
"""


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("high = 1e-1", "high = 1e-9", r"space.toml:2: 'penalty': low \(1e-06\) must not be above"),
        ("low = 1e-6", "low = 0", r"space.toml:2: 'penalty': low is 0: log needs more than 0"),
        (
            "low = 1e-6",
            "low = nan",
            r"space.toml:3: 'penalty.low': input should be a finite number",
        ),
        ("low = 1e-6", "", r"space.toml:2: 'penalty': give choices, or low and high"),
        ("log = true", "integer = true", "must be whole numbers"),
        (
            '["pose", "play"]',
            "[]",
            r"space.toml:7: 'features.choices': list should have at least 1",
        ),
    ],
)
def test_a_search_space_that_makes_no_sense(
    old: str, new: str, reason: str, tmp_path: Path
) -> None:
    space = tmp_path / "space.toml"
    space.write_text(SPACE.replace(old, new))
    with pytest.raises(EstimatorError, match=reason):
        read_space(space)


def test_the_search_space_of_the_documentation_fits_the_estimator() -> None:
    space = read_space(Path(__file__).parents[2] / "docs" / "examples" / "space.toml")
    registry = Registry.discover()
    for end in (0, -1):
        drawn = {name: (one.choices or [one.low, one.high])[end] for name, one in space.items()}
        assert registry.build(Estimator, "mlp", drawn).name == "mlp"


@pytest.fixture
def words(data: Path, tmp_path: Path) -> list[str]:
    """A sweep of two trials."""
    pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    space = tmp_path / "space.toml"
    space.write_text(SPACE)
    words = ["sweep", str(data), str(space), "--journal", str(tmp_path / "journal.log")]
    return [*words, "--estimator", "ridge", "--trials", "2"]


def test_a_sweep_goes_on_with_the_same_data_only(
    small: Dataset, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words[1] = str(tmp_path / "own.parquet")
    files.write_dataset(Path(words[1]), small, [], "the small simulated data set")
    assert main(words) == 0
    capsys.readouterr()
    assert main([*words[:-1], "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["finished"] == 3
    Path(words[2]).write_text(SPACE.replace('"pose", "play"', '"play", "pose", "window"'))
    assert main([*words[:-1], "4"]) == 2
    assert "the space does not go with the journal's trials" in capsys.readouterr().err
    files.write_dataset(Path(words[1]), replace(small, errors_mm=-small.errors_mm), [], "others")
    assert main(words) == 2
    assert "or the data have changed since" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [ValueError, DivergedError])
def test_a_sweep_whose_trials_all_fail_ends(
    kind: type[Exception],
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It used to go on for ever."""

    def fails(*_: object) -> float:
        raise kind("the fit failed")

    monkeypatch.setattr("measure_learning.core.sweeping.run_trial", fails)
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "2 trials failed and 0 finished; the last failure: the fit failed" in told
    assert main([*words[:-1], "0"]) == 2
    assert "--trials 0: expected a positive number" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b'penalty = "none"\n', b'{"op_code":0', b"another", b"torn"])
def test_a_file_that_is_no_journal_is_left_alone(
    content: bytes, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    journal = Path(words[4])
    if content == b"another":
        with closing(sqlite3.connect(journal)) as file:
            file.execute("CREATE TABLE songs (name TEXT)")
        content = journal.read_bytes()
    elif content == b"torn":
        with sweeping.open_study(journal, "a job"):
            pass
        content = journal.read_bytes()[:5000]
    journal.write_bytes(content)
    assert main(words) == 2
    assert f"{journal}: damaged, or not a sweep's journal (" in capsys.readouterr().err
    assert journal.read_bytes() == content


HEARTBEAT_S = 1
"""The shortest that optuna knows; a trial is given up after three of them."""
JOB = sweeping.SweepJob("data", "ridge", {}, 0, "digest")


def _hang(journal: Path, drawn: Any) -> None:
    """What a worker does that is killed later on."""
    sweeping.run_trial = lambda _, settings: (drawn.put(settings), time.sleep(600.0))[1]
    _sweep(journal, 1)


def _sweep(journal: Path, trials: int) -> sweeping.SweepState:
    space = {"penalty": Range(low=0.0, high=1.0)}
    return sweeping.sweep(JOB, space, journal, trials, report=quiet, heartbeat_s=HEARTBEAT_S)


def test_the_settings_of_a_killed_worker_are_tried_again_and_a_slow_one_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the system: no process is asked for by its number."""
    pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    spawn, journal, tried = multiprocessing.get_context("spawn"), tmp_path / "a?b.db", []
    drawn = spawn.Queue()
    worker = spawn.Process(target=_hang, args=(journal, drawn))
    worker.start()
    lost = drawn.get(timeout=60.0)
    worker.kill()
    worker.join()

    def slowly(_: object, settings: dict[str, float]) -> float:
        tried.append(settings)
        time.sleep(5.0 * HEARTBEAT_S if len(tried) == 1 else 0.01)
        return settings["penalty"]

    monkeypatch.setattr(sweeping, "run_trial", slowly)
    state = _sweep(journal, 3)
    assert tried[1] == lost  # the first began before it was known
    assert lost not in (tried[0], tried[2])
    assert (state.finished, state.failed, state.running, state.waiting) == (3, 1, 0, 0)
    assert [score for score, _ in state.best] == sorted(one["penalty"] for one in tried)


def test_a_trial_that_others_gave_up_does_not_end_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of a machine that slept; a healthy trial of the same sweep counts."""
    optuna = pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    journal, tried = tmp_path / "journal.db", []

    def given_up(_: object, settings: dict[str, float]) -> float:
        tried.append(settings)
        if len(tried) == 1:
            with sweeping.open_study(journal, JOB.identity) as study:
                study.tell(0, state=optuna.trial.TrialState.FAIL)
        return 1.0

    monkeypatch.setattr(sweeping, "run_trial", given_up)
    state = _sweep(journal, 2)
    assert (len(tried), state.finished, state.failed) == (3, 2, 1)


@pytest.mark.slow
def test_the_workers_of_a_cluster_run_the_trials(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed", reason="a scheduler needs the extra 'cluster'")
    with Cluster(tmp_path) as cluster:
        assert main([*words, "--cluster", cluster.address, "--json"]) == 0
        state = json.loads(capsys.readouterr().out)
        assert state["finished"] >= 2
        assert all(0 < score < 100 for score, _ in state["best"])
        Path(words[2]).write_text("[penalty]\nchoices = [-1.0]\n")
        words[4] += ".other"
        assert main([*words, "--cluster", cluster.address]) == 2
        assert "'penalty': input should be greater than 0, got -1.0" in capsys.readouterr().err


def test_a_scheduler_that_is_not_there_is_named(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna", reason="a sweep needs the extra 'sweep'")
    pytest.importorskip("distributed", reason="a scheduler needs the extra 'cluster'")
    monkeypatch.setattr("measure.processes._CONNECT_S", 0.3)
    space = tmp_path / "space.toml"
    space.write_text(SPACE)
    words = ["sweep", str(data), str(space), "--journal", str(tmp_path / "journal.log")]
    words += ["--estimator", "ridge", "--cluster", "tcp://127.0.0.1:9"]
    assert main(words) == 2
    assert "--cluster tcp://127.0.0.1:9: no scheduler answers there" in capsys.readouterr().err
