"""Kills at random moments: a run that is resumed equals the one that nobody killed."""

from __future__ import annotations

import random
import signal
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults.killed import Ended, Moment, Process
from benchmarks.faults.killed_commands import Loss, commands, killed
from measure.cli import main
from measure.errors import MeasureError
from measure.results import read_run
from measure.simulation import write_session
from measure.simulation.catalogue import webcam_scene
from tests.simulated.catalogue import occluded_scene
from tests.simulated.sessions import part_of

SETS = 20
_RENDERS = Path(__file__).resolve().parents[2] / "shared" / "renders"
_DIFFERENT = {"run.toml", "run.rrd"}
"""Files that hold when a run was begun."""


@dataclass(frozen=True)
class Case:
    """A session and how it is measured.

    Attributes:
        name: of the two together.
        session: its folder.
        profile: built-in profile.
    """

    name: str
    session: Path
    profile: str

    def words(self, out: Path, *more: str) -> list[str]:
        """The command that measures it."""
        return ["run", str(self.session), "-o", str(out), "--profile", self.profile, *more]

    def measured(self, out: Path, *more: str, moment: Moment | None = None) -> Ended:
        """Measure it in a process of its own."""
        return Process(main, (self.words(out, *more),), out, moment).end()


@dataclass(frozen=True)
class Uninterrupted:
    """A run that nobody killed, and what its process did to its files."""

    case: Case
    out: Path
    steps: tuple[str, ...]

    @classmethod
    def of(cls, case: Case, out: Path) -> Uninterrupted:
        """Measure a session undisturbed."""
        ended = case.measured(out)
        assert ended.code == 0, ended.said
        return cls(case, out, ended.steps)

    def stages(self) -> dict[str, list[int]]:
        """The steps that belong to the start, to measuring and to closing."""
        rows = [k for k, step in enumerate(self.steps) if step.startswith("row")]
        return {
            "start": [k for k in range(rows[0]) if not self.steps[k].startswith("os.remove")],
            "measuring": list(range(rows[0], rows[-1] + 1)),
            "closing": list(range(rows[-1] + 1, len(self.steps))),
        }

    def rows_before(self, step: int) -> int:
        """How many frame sets were written before a step."""
        return sum(one.startswith("row") for one in self.steps[:step])

    def differs_from(self, out: Path) -> list[str]:
        """Files that another run of the same has not to the byte, or has too many."""
        ours, theirs = _contents(self.out), _contents(out)
        return sorted(name for name in ours.keys() | theirs if ours.get(name) != theirs.get(name))


@dataclass(frozen=True)
class Outcome:
    """What came of a run that was killed and resumed.

    Attributes:
        refused: what the resumed run said instead of measuring; empty if it was done.
        differing: files that are not those of an uninterrupted run.
        rows_lost: rows of `poses.csv` that a kill cost.
    """

    refused: str
    differing: list[str]
    rows_lost: int


def killed_and_resumed(whole: Uninterrupted, out: Path, moments: list[Moment]) -> Outcome:
    """Measure, killed at the first moment, then resumed and killed at each further one, then done.

    Args:
        whole: the same, uninterrupted.
        out: the run's folder.
        moments: at least one.
    """
    lost, more = 0, list[str]()
    kept = whole.rows_before(moments[0].step)
    for moment in moments:
        ended = whole.case.measured(out, *more, moment=moment)
        if ended.code not in (0, -signal.SIGKILL):
            return Outcome(ended.said, [], lost)
        lost += max(kept - csv_rows(out / "poses.csv"), 0)
        kept, more = kept_rows(out), ["--resume"]
    ended = whole.case.measured(out, "--resume")
    return Outcome(ended.said if ended.code else "", whole.differs_from(out), lost)


def second_writers(case: Case, out: Path, step: int) -> tuple[dict[str, Ended], Ended]:
    """What is said to commands that would write into a run being written, and its end.

    Args:
        case: what is measured.
        out: the run's folder.
        step: of the first writer, which waits there for the others to end.
    """
    first = Process(main, (case.words(out),), out, Moment(step, signal=signal.SIGSTOP))
    first.wait_until_stopped()
    live = ["live", *(f"cam{k}=http://127.0.0.1:9/" for k in range(4)), "-o", str(out)]
    live += ["--calibration", f"{case.session}/calibration.toml"]
    live += ["--body", f"{case.session}/body.toml"]
    others = {
        "run": case.words(out),
        "run --resume": case.words(out, "--resume"),
        "run --overwrite": case.words(out, "--overwrite"),
        "live": live,
        "live --overwrite": [*live, "--overwrite"],
        "evaluate": ["evaluate", str(out)],
    }
    try:
        ended = {
            name: Process(main, (words,), out.with_name("other"), None).end()
            for name, words in others.items()
        }
    finally:
        first.go_on()
    return ended, first.end()


def rows(count: int, seed: int) -> list[tuple[str, str]]:
    """Kill runs at random moments, resume them and compare; then other commands, and two writers.

    Args:
        count: how many runs are killed; of each other command a third as many.
        seed: of the moments.

    Returns:
        What was tried, and what came out, by session and moment.
    """
    with tempfile.TemporaryDirectory() as name:
        folder, rng = Path(name), random.Random(seed)
        wholes = [Uninterrupted.of(case, folder / case.name) for case in _cases(folder)]
        outcomes = defaultdict[str, list[Outcome]](list)
        for k in range(count):
            whole = wholes[k % len(wholes)]
            what, moments = _random_moments(whole, rng)
            done = killed_and_resumed(whole, folder / f"killed{k}", moments)
            outcomes[f"{whole.case.name}: killed {what}"].append(done)
        table = [(what, _told(done)) for what, done in sorted(outcomes.items())]
        table.append(("all kills", _told([one for done in outcomes.values() for one in done])))
        for command in commands(folder / "of commands"):
            losses = killed(command, folder / command.name, max(count // 3, 1), rng)
            table.append((f"{command.name}: killed", _costs(losses)))
        return table + _two_writers(wholes, folder)


def _random_moments(whole: Uninterrupted, rng: random.Random) -> tuple[str, list[Moment]]:
    """One kill in some stage, and once in two a second one while the run is resumed."""
    stages = whole.stages()
    stage = rng.choice(list(stages))
    moments = [Moment(rng.choice(stages[stage]), rng.choice([0.0, rng.uniform(0.0, 0.03)]))]
    what = {"start": "at the start", "measuring": "while measuring", "closing": "while closing"}
    if rng.random() < 0.5:
        return what[stage], moments
    again = Moment(rng.randrange(len(whole.steps)), rng.uniform(0.0, 0.03))
    return f"{what[stage]}, again while resuming", [*moments, again]


def _told(outcomes: list[Outcome]) -> str:
    equal = sum(not one.refused and not one.differing for one in outcomes)
    text = f"{len(outcomes)} killed: {equal} byte-equal, "
    text += f"{sum(bool(one.refused) for one in outcomes)} refused, "
    text += f"{sum(one.rows_lost for one in outcomes)} rows lost"
    wrong = [one.refused or ", ".join(one.differing) for one in outcomes]
    return "; ".join([text, *sorted({" ".join(word.split()) for word in wrong if word})])


def _costs(losses: list[Loss]) -> str:
    free = sum(not loss.text for loss in losses)
    what = sorted({" ".join(loss.text.split()) for loss in losses if loss.text})
    text = f"{len(losses)} killed: {free} lost nothing, left nothing, and were done again"
    return "; ".join([text, *what])


def _two_writers(wholes: list[Uninterrupted], folder: Path) -> list[tuple[str, str]]:
    whole, out = wholes[0], folder / "two writers"
    measuring = whole.stages()["measuring"]
    others, first = second_writers(whole.case, out, measuring[len(measuring) // 2])
    told = [
        (f"{name}, into a run being written", f"exit code {ended.code}: {_last_line(ended.said)}")
        for name, ended in others.items()
    ]
    differing = ", ".join(whole.differs_from(out)) or "byte-equal"
    return [*told, ("the run being written", f"exit code {first.code}: {differing}")]


def _cases(folder: Path) -> list[Case]:
    plain, occluded = (_session(name, folder) for name in ("still", "occluded"))
    return [
        Case("plain", plain, "precise"),
        Case("occluded", occluded, "precise"),
        Case("paper profile", occluded, "paper"),
    ]


def _session(name: str, folder: Path) -> Path:
    """The start of a recording that lies beside the repository, or else one that is rendered."""
    if (_RENDERS / name).is_dir():
        return part_of(_RENDERS / name, range(SETS), folder / "sessions" / name)
    scene = webcam_scene() if name == "still" else occluded_scene()
    write_session(scene, np.arange(SETS) / 30.0, folder / "sessions" / name)
    return folder / "sessions" / name


def csv_rows(path: Path) -> int:
    """How many whole rows `poses.csv` has; none if it is not there."""
    return max(path.read_bytes().count(b"\n") - 1, 0) if path.exists() else 0


def kept_rows(out: Path) -> int:
    """How many frame sets a run that was killed can be resumed with."""
    try:
        return len(read_run(out).poses)
    except MeasureError:
        return 0


def _contents(out: Path) -> dict[str, bytes]:
    return {
        path.name: b"" if path.name in _DIFFERENT else path.read_bytes() for path in out.iterdir()
    }


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1]
