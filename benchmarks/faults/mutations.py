"""Changed files of every kind: `python -m benchmarks.faults mutations --count N`.

Each of N times a file of some kind is changed in some way, and the command that reads it is run in
a process of its own. It may succeed, or refuse in one line with exit code 2; it may not end with a
traceback, hang, take more than 2 GB, or move a believed pose by more than its stated 95 % without
a word. A file may be changed into one that is as likely and says another geometry or other times:
no program can see that, so poses that moved are counted apart where the changed file is one of
those, and what the run said of them.
"""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults.killed import context
from benchmarks.faults.subjects import SUBJECTS, Subject, done, rendered, write_seeds
from measure.cli import main
from measure.errors import MeasureError
from measure.results import Run, read_run

AT_MOST_S = 20
AT_MOST_BYTES = 2 << 30
_CHI2_95 = 7.815
"""Of three degrees of freedom."""
_OF_A_ROBOT = ("dataset", "estimate", "train")
_WRITTEN = ("journal", "net.checkpoint")
"""Folders of seeds that commands write into."""


@dataclass(frozen=True)
class Outcome:
    """What came of a changed file.

    Attributes:
        subject: the kind of file.
        how: it was changed.
        fault: what must not be; empty if nothing was.
        refused: whether the command refused.
        said: what was printed.
        moved: believed poses that moved by more than their stated 95 %.
        told: whether the run said more, or flagged more, than that of the unchanged file.
    """

    subject: str
    how: str
    fault: str
    refused: bool = False
    said: str = field(default="", repr=False)
    moved: int = 0
    told: bool = False


class Mutations:
    """Seeds, and what the unchanged ones give.

    Args:
        folder: for all files.
        subjects: kinds to change.
        session: writes the recording; rendered if omitted.
    """

    def __init__(
        self,
        folder: Path,
        subjects: tuple[Subject, ...] = SUBJECTS,
        session: Callable[[Path], object] = rendered,
    ) -> None:
        self._folder, self._subjects = folder, subjects
        self._seeds = folder / "seeds"
        self._seeds.mkdir(parents=True)
        robot = any(subject.words.startswith(_OF_A_ROBOT) for subject in subjects)
        write_seeds(self._seeds, session, robot=robot)
        self._runs: dict[str, tuple[Run, str]] = {}
        for subject in subjects:
            if subject.run and subject.words not in self._runs:
                out = folder / f"whole{len(self._runs)}"
                said = done(subject.words.replace("{}/new", str(out)), self._seeds)
                self._runs[subject.words] = read_run(out), said

    def try_one(self, number: int, draw: random.Random) -> Outcome:
        """Change a file of some kind, and run its command."""
        subject = draw.choice(self._subjects)
        here = self._folder / f"try{number}"
        _copy(self._seeds, here, subject.file)
        how = draw.choice(subject.mutations)(here / subject.file, draw)
        log = here.with_suffix(".log")
        process = context().Process(
            target=_run, args=(subject.words.replace("{}", str(here)).split(), log)
        )
        process.start()
        process.join(6 * AT_MOST_S)
        if process.is_alive():
            process.kill()
            process.join()
        outcome = self._judged(subject, how, here, process.exitcode or 0, log)
        if not outcome.fault:
            shutil.rmtree(here)
        return outcome

    def _judged(self, subject: Subject, how: str, here: Path, code: int, log: Path) -> Outcome:
        said = log.read_text("utf-8", "replace") if log.exists() else ""
        peak = log.with_suffix(".peak")
        fault = fault_of(code, said, int(peak.read_text()) if peak.exists() else 0)
        if fault or code == 2 or not subject.run:
            return Outcome(subject.name, how, fault, code == 2, said)
        whole, before = self._runs[subject.words]
        try:
            run = read_run(here / "new")
        except MeasureError as error:
            return Outcome(subject.name, how, f"writes what cannot be read: {error}", said=said)
        told = len(run.summary.notes) + len(run.contradictions) > (
            len(whole.summary.notes) + len(whole.contradictions)
        ) or len(said.splitlines()) > len(before.splitlines())
        return Outcome(subject.name, how, "", said=said, moved=moved(whole, run), told=told)


def fault_of(code: int, said: str, peak_bytes: int) -> str:
    """What a command did that none may do; empty if nothing.

    Args:
        code: its exit code, or minus the signal that killed it.
        said: what it printed.
        peak_bytes: most memory it had.
    """
    if code in (-signal.SIGALRM, -signal.SIGXCPU, -signal.SIGKILL):
        return "hangs"
    if "Traceback (most" in said or code not in (0, 2, 3):
        return f"traceback, or exit code {code}"
    if peak_bytes > AT_MOST_BYTES:
        return f"takes {peak_bytes >> 20} MB"
    if code == 2 and sum(line.startswith("measure: ") for line in said.splitlines()) != 1:
        return "refuses in more or less than one line"
    return ""


def _copy(seeds: Path, here: Path, changed: str) -> None:
    """Copy seeds by links, but what is changed or written into."""

    def copy(source: str, to: str) -> str:
        own = Path(source).relative_to(seeds)
        if str(own) == changed or own.parts[0] in _WRITTEN:
            shutil.copy(source, to)
        else:
            os.link(source, to)
        return to

    shutil.copytree(seeds, here, copy_function=copy)


def _run(words: list[str], log: Path) -> None:
    """Run a command in this process, whose time and memory are bounded."""
    with log.open("wb") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    # Elsewhere the machine may be at work: of its own time a command takes no more than that, and
    # one that waits for nothing to come takes it threefold by the clock.
    resource.setrlimit(resource.RLIMIT_CPU, (AT_MOST_S, AT_MOST_S))
    signal.alarm(3 * AT_MOST_S)
    code = main(words)
    sys.stdout.flush()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    log.with_suffix(".peak").write_text(str(peak))
    os._exit(code)


def moved(whole: Run, run: Run) -> int:
    """Believed poses of the same instants that lie apart by more than the stated 95 %."""
    if not (whole.has_pose.any() and run.has_pose.any()):
        return 0
    ours, theirs = _believed(whole), _believed(run)
    count = 0
    for time in ours.keys() & theirs.keys():
        place, turn, _ = ours[time]
        other, other_turn, covariance = theirs[time]
        shift = other - place
        angles = _rotvec(other_turn @ turn.T)
        far = [
            float(part @ np.linalg.solve(block, part)) > _CHI2_95
            for part, block in ((shift, covariance[:3, :3]), (angles, covariance[3:, 3:]))
        ]
        count += any(far)
    return count


def _believed(run: Run) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Position, rotation and covariance of the poses that are ok, by frame set."""
    ok = np.array(run.poses["status"].to_pylist())[run.has_pose] == "ok"
    index = run.poses["index"].to_numpy()[run.has_pose]
    poses, covariances = run.world_from_body, run.covariances
    return {
        int(index[k]): (poses.translation[k], poses.rotation[k], covariances[k])
        for k in np.flatnonzero(ok)
    }


def _rotvec(rotation: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(rotation)[0].ravel()


def rows(count: int, seed: int) -> list[tuple[str, str]]:
    """Change `count` files and tell what came of it, by kind of file, and all that must not be."""
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        mutations = Mutations(Path(name))
        outcomes = [mutations.try_one(k, draw) for k in range(count)]
    kinds = defaultdict[str, list[Outcome]](list)
    for outcome in outcomes:
        kinds[outcome.subject].append(outcome)
    table = [(kind, told(some)) for kind, some in sorted(kinds.items())]
    faults = [(f"{one.subject}: {one.how}", _short(one)) for one in outcomes if one.fault]
    return [*table, *faults, ("all mutations", told(outcomes))]


def told(outcomes: list[Outcome]) -> str:
    """Counts in words."""
    moved = [one for one in outcomes if one.moved]
    what = Counter(one.fault.split(",")[0].split(":")[0] for one in outcomes if one.fault)
    parts = [f"{len(outcomes)} changed", f"{sum(one.refused for one in outcomes)} refused"]
    parts += [f"{number} {fault}" for fault, number in sorted(what.items())]
    parts += [f"{len(moved)} moved poses, {sum(one.told for one in moved)} of them told"]
    return ", ".join(parts)


def _short(outcome: Outcome) -> str:
    last = (outcome.said.strip().splitlines() or [""])[-1]
    return f"{outcome.fault}: {last[:160]}"
