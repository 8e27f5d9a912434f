"""Sweeps, as typed: spaces that make sense, and workers that are killed."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest

from measure.cli import main
from measure.errors import DivergedError, EstimatorError
from measure.host import Dataset, Estimator, Registry
from measure_learning.core import files, sweeping
from measure_learning.core.sweeping import read_space

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


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('penalty = "none"\n', "journal.log:1: damaged, or not a sweep's journal"),
        ('{"op_code":0', "journal.log:1: damaged, or not a sweep's journal"),
        ("1\n", "journal.log:1: damaged, or not a sweep's journal"),
        ('{"op_code":99,"worker_id":"a"}\n', "journal.log: damaged"),
    ],
)
def test_a_file_that_is_no_journal_is_left_alone(
    content: str, reason: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    journal = Path(words[4])
    journal.write_text(content)
    assert main(words) == 2
    assert reason in capsys.readouterr().err
    assert journal.read_text() == content


def test_a_silent_trial_is_given_up_and_a_living_one_is_not(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the system: no process is asked for by its number."""
    study, seen = sweeping.open_study(Path(words[4]), "a job"), dict[int, tuple[int, float]]()
    space = read_space(Path(words[2]))
    monkeypatch.setattr(sweeping, "_BEAT_S", 0.05)
    monkeypatch.setattr(sweeping, "_SILENT_S", 1.0)
    (silent, settings), (living, _) = (sweeping.ask(study, space) for _ in range(2))
    with sweeping.alive([living]):
        begun = time.monotonic()
        while sweeping.sweep_state(study).running == 2 and time.monotonic() < begun + 20.0:
            sweeping.requeue_dead(study, seen)
            time.sleep(0.05)
    state = sweeping.sweep_state(study)
    assert (state.running, state.failed, state.waiting) == (1, 1, 1)
    sweeping.finish(study, silent, lambda: 1.0)  # it was only slow: nobody stumbles over it
    sweeping.finish(study, living, lambda: 2.0)
    assert sweeping.sweep_state(study).best[0][0] == 2.0
    assert sweeping.ask(study, space)[1] == settings


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
