"""Processes that are killed at a moment that was chosen before."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from measure.results.journal import GrowingFile

_FILE_EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.truncate"}
_AT_MOST_S = 300.0


@dataclass(frozen=True)
class Moment:
    """When a process is stopped, in steps: what it does to files of one folder, one by one.

    Attributes:
        step: number of the step before which it is.
        delay_s: how much later than that.
        signal: what stops it.
    """

    step: int
    delay_s: float = 0.0
    signal: signal.Signals = signal.SIGKILL


@dataclass
class Steps:
    """Counts what this process does to the files of a folder, and stops it at its moment.

    Opening, renaming and removing are steps, and so is every row of `poses.csv`; the tables are
    not, for when they are written is a matter of time.
    """

    folder: Path
    moment: Moment | None
    done: list[str] = field(default_factory=list)

    def count_from_now_on(self) -> None:
        """Begin; it never ends in this process."""
        append = GrowingFile.append

        def counted(file: GrowingFile, data: bytes) -> None:
            if file.path.name == "poses.csv":
                self._step(f"row {data[:8]!r}")
            append(file, data)

        GrowingFile.append = counted  # type: ignore[method-assign, assignment]
        sys.addaudithook(self._on_event)

    def _on_event(self, event: str, args: tuple[Any, ...]) -> None:
        if event in _FILE_EVENTS and isinstance(args[0], str | bytes | os.PathLike):
            path = os.fsdecode(args[0])
            if path.startswith(os.fspath(self.folder)):
                self._step(f"{event} {Path(path).name}")

    def _step(self, what: str) -> None:
        moment = self.moment
        if moment is not None and moment.step == len(self.done):
            if moment.delay_s:
                threading.Thread(target=_stop, args=(moment,), daemon=True).start()
            else:
                _stop(moment)
        self.done.append(what)


def _stop(moment: Moment) -> None:
    time.sleep(moment.delay_s)
    os.kill(os.getpid(), moment.signal)


@dataclass(frozen=True)
class Ended:
    """A process that has ended.

    Attributes:
        code: its exit code; minus the signal that killed it.
        said: what it printed, on stdout and stderr.
        steps: what it did to the files of the folder; empty if it was killed.
    """

    code: int
    said: str
    steps: tuple[str, ...]


class Process:
    """Work in a process of its own, which a fork server makes: what is imported is there at once.

    Args:
        work: called there.
        args: with these.
        folder: whose files' changes are the steps.
        moment: when the process is stopped; never if None.
    """

    def __init__(
        self, work: Callable[..., int], args: tuple[Any, ...], folder: Path, moment: Moment | None
    ) -> None:
        self._log = folder.with_name(f"{folder.name}.{time.monotonic_ns()}.log")
        started = (work, args, folder, moment, self._log)
        self._process = context().Process(target=_run, args=started)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def wait_until_stopped(self) -> None:
        """Wait until SIGSTOP has stopped it."""
        stat = Path(f"/proc/{self.pid}/stat")
        until = time.monotonic() + _AT_MOST_S
        while stat.read_text("utf-8").rpartition(")")[2].split()[0] != "T":
            assert time.monotonic() < until, "it was not stopped"
            assert self._process.is_alive(), self._log.read_text()
            time.sleep(0.01)

    def go_on(self) -> None:
        """Let it go on after SIGSTOP."""
        os.kill(self.pid, signal.SIGCONT)

    def end(self) -> Ended:
        """Wait for its end."""
        self._process.join(_AT_MOST_S)
        assert self._process.exitcode is not None, "it hangs"
        steps = self._log.with_suffix(".steps")
        done = tuple(steps.read_text().splitlines()) if steps.exists() else ()
        return Ended(self._process.exitcode, self._log.read_text(), done)


def context() -> multiprocessing.context.ForkServerContext:
    """A fork server that has imported and compiled what commands need."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["benchmarks.faults.warm"])
    return server


def _run(
    work: Callable[..., int], args: tuple[Any, ...], folder: Path, moment: Moment | None, log: Path
) -> None:
    with log.open("wb") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)
    steps = Steps(folder, moment)
    steps.count_from_now_on()
    code = work(*args)
    sys.stdout.flush()
    log.with_suffix(".steps").write_text("\n".join(steps.done))
    os._exit(code)  # what follows costs more than the work
