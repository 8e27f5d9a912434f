"""Commands that write one file, and the studio, killed at random moments: nothing is lost by it."""

from __future__ import annotations

import random
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.faults.killed import Ended, Moment, Process
from benchmarks.registration import recorded, robot_toml
from measure.cli import main
from measure_learning.robots import write_log
from tests.metrology.recordings import write_run
from tests.simulated.capture import CaptureScene, write_capture

_WHEN_MADE = ("created", "made", "date")
"""What lines of a file begin with that tell when it was written."""


@dataclass(frozen=True)
class Command:
    """A command that is killed.

    Attributes:
        name: of the command.
        words: after it; `{}` stands for the folder that it writes into.
        out: name of the file that it writes there; empty if it serves a folder.
    """

    name: str
    words: tuple[str, ...]
    out: str = ""

    def done(self, folder: Path, *more: str, moment: Moment | None = None) -> Ended:
        """Do it in a process of its own."""
        words = [self.name, *(word.format(folder) for word in (*self.words, *more))]
        return Process(main, (words,), folder, moment).end()


@dataclass(frozen=True)
class Loss:
    """What a kill cost: in words each, empty if nothing."""

    torn: str = ""
    left: str = ""
    refused: str = ""

    @property
    def text(self) -> str:
        """All of it."""
        return ", ".join(filter(None, (self.torn, self.left, self.refused)))


def commands(folder: Path) -> list[Command]:
    """Each with what it reads, written into a folder."""
    write_capture(CaptureScene(boards_per_camera=5), folder / "capture")
    arm = recorded(7, seconds=40.0, frame_hz=8.0)
    run = write_run(folder / "run", arm.track.table())
    write_log(folder / "robot.csv", arm.log)
    (folder / "robot.toml").write_text(robot_toml())
    robot = "--robot-log", str(folder / "robot.csv"), "--robot", str(folder / "robot.toml")
    return [
        Command("calibrate", (str(folder / "capture"), "-o", "{}/new.toml"), "new.toml"),
        Command("register", (str(run), *robot, "-o", "{}/frame.toml"), "frame.toml"),
        Command("export", (str(run), "-f", "csv", "-o", "{}/poses.csv"), "poses.csv"),
        Command("studio", ("{}", "--port", "0", "--no-browser", "--seconds", "2")),
    ]


def killed(command: Command, folder: Path, count: int, rng: random.Random) -> list[Loss]:
    """What each of so many kills cost.

    In the folder stands a file of before, which the command replaces, and another of the user's.
    """
    whole, begun_s = folder / "whole", time.monotonic()
    whole.mkdir(parents=True)
    ended = command.done(whole)
    assert ended.code == 0, ended.said
    lasts_s, steps = time.monotonic() - begun_s, max(len(ended.steps), 1)
    losses = []
    for number in range(count):
        at = folder / f"killed{number}"
        shutil.copytree(whole, at)
        (at / "notes.txt").write_text("a user's own")
        if command.out:
            (at / command.out).write_text("of before")
        late_s = rng.choice([0.0, rng.uniform(0.0, lasts_s)])
        losses.append(_cost(command, at, whole, Moment(rng.randrange(steps), late_s)))
    return losses


def _cost(command: Command, at: Path, whole: Path, moment: Moment) -> Loss:
    before = _files(at)
    again = ("--overwrite",) if command.out else ()
    ended = command.done(at, *again, moment=moment)
    if ended.code not in (0, -signal.SIGKILL):
        return Loss(refused=ended.said)
    torn = [
        name
        for name, data in before.items()
        if _files(at).get(name) not in (data, _files(whole).get(name))
    ]
    ended = command.done(at, *again)
    if ended.code:
        return Loss(", ".join(torn), refused=ended.said)
    wanted = _files(whole) | {"notes.txt": before["notes.txt"]}
    there = _files(at)
    torn += [name for name, data in wanted.items() if there.get(name) != data]
    left = [path.name for path in at.iterdir() if path.name not in wanted]
    return Loss(", ".join(torn), ", ".join(left))


def _files(folder: Path) -> dict[str, list[bytes]]:
    """The lines of all files but those that tell when they were written."""
    made = tuple(word.encode() for word in _WHEN_MADE)
    return {
        path.name: [line for line in path.read_bytes().splitlines() if not line.startswith(made)]
        for path in folder.iterdir()
        if path.is_file() and not path.name.startswith(".")
    }
