"""A run replayed at its own pace, into sinks and a viewer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from threading import Event

import numpy as np

from measure.api.reel import Reel
from measure.api.run_log import LogOptions
from measure.arrays import Floats
from measure.errors import ConfigError
from measure.host import Registry
from measure.processes import until_stopped
from measure.results import read_runs
from measure_studio.api.sending import SendOptions, open_sending


@dataclass(frozen=True)
class Pace:
    """How fast a recording is played, and when.

    Attributes:
        rate: how many times as fast as it was recorded.
        loop: begin again at its end.
        wait_s: seconds before the first pose or picture, so that all receivers are ready.
    """

    rate: float = 1.0
    loop: bool = False
    wait_s: float = 1.0

    def check_pace(self) -> None:
        """Refuse (ConfigError) a pace that is none."""
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise ConfigError(f"--rate {self.rate:g}: expected a number above 0")
        if not 0 <= self.wait_s < math.inf:
            raise ConfigError(f"--wait-s {self.wait_s:g}: expected seconds, 0 or more")


@dataclass(frozen=True)
class PlayOptions(Pace, SendOptions):
    """How a run is played, and where to.

    Attributes:
        connect: send to a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
    """

    connect: str | None = None


@dataclass(frozen=True)
class PlayEnd:
    """A replay that has ended."""

    frame_sets: int  # how many were played
    late_s: float  # the most by which one came after its turn
    sent: Mapping[str, Mapping[str, int]]  # what came of the poses for each address


def play(
    folder: Path, registry: Registry, options: PlayOptions, over: Event | None = None
) -> PlayEnd:
    """Play a run, finished or not, until its end, until interrupted, or until `over` is set.

    Raises:
        MeasureError: the folder is no run, an address or setting is none, or there is no viewer.
    """
    options.check_pace()
    if not (options.send or options.connect):
        raise ConfigError(
            "where is it to be played to? give --send ADDRESS, --spawn or --connect; --as-cameras "
            "serves the cameras of a session"
        )
    LogOptions(options.connect).check_viewer()
    reel = Reel(read_runs(folder))
    sending = open_sending(options, registry, reel.run)
    with ExitStack() as stack:
        stop = stack.enter_context(until_stopped(over))
        stack.enter_context(sending)
        show = _viewer(stack, reel, options)
        played, late_s = 0, 0.0
        stop.wait(options.wait_s)
        begun, since_1970 = time.monotonic(), time.time() - time.monotonic()
        for number, due_s in _turns(reel.times_s, options):
            if stop.wait(max(begun + due_s - time.monotonic(), 0.0)):
                break
            exposed_s, now_s = since_1970 + begun + due_s, since_1970 + time.monotonic()
            marks = reel.marks(number, exposed_s, options.rate)
            sending.send(reel.poses(number, exposed_s, now_s), marks)
            late_s = max(late_s, time.monotonic() - begun - due_s)
            show(number)
            played += 1
    return PlayEnd(played, late_s, sending.counts)


def _turns(times_s: Floats, pace: Pace) -> Iterator[tuple[int, float]]:
    """Number of every frame set to be played, and its turn in seconds from the start."""
    period_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    since_s = (times_s - times_s[0]).tolist()
    for round_ in count() if pace.loop else (0,):
        for number, time_s in enumerate(since_s):
            yield number, (round_ * (since_s[-1] + period_s) + time_s) / pace.rate


def _viewer(stack: ExitStack, reel: Reel, options: PlayOptions) -> Callable[[int], None]:
    """What shows a frame set in a viewer; nothing without one."""
    if options.connect is None:
        return lambda _: None
    from measure.viewing.recording import RunRecording, open_recording

    run = reel.run
    names = [body.name for body in run.bodies]
    stream = open_recording(
        run.name, run.cameras, address=options.connect, bodies=names, note=options.on_note
    )
    log = stack.enter_context(RunRecording(stream, run.bodies, run.cameras, 0, live=True))
    return lambda number: log.add(reel.measurements(number))
