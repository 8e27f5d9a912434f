"""A run replayed at its own pace, into sinks and a viewer."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow as pa

from measure.api.folders import events
from measure.api.run_log import LogOptions
from measure.api.sending import SendOptions, open_sending
from measure.arrays import Floats
from measure.errors import ConfigError, RunError
from measure.geometry import RigidTransform
from measure.host import EventMark, Registry, SentPose, SentRun
from measure.measuring import Measurement, Status
from measure.model import BallPosition, Pose
from measure.processes import until_stopped
from measure.results import Run, read_runs
from measure.results.journal import is_missing
from measure.results.stored import rows_of_body
from measure.results.tables import BODY, PLACE, matrices, numbers


@dataclass(frozen=True)
class Pace:
    """How fast a recording is played, and when.

    Attributes:
        rate: how many times as fast as it was recorded.
        loop: begin again at its end.
        wait_s: seconds before the first pose or picture, so that receivers are all there.
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
    """How a run is played, and where to."""

    viewer: str | None = None  # address of a running viewer


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
    if not (options.send or options.viewer):
        raise ConfigError(
            "where is it to be played to? give --send ADDRESS, --spawn or --connect; --as-cameras "
            "serves the cameras of a session"
        )
    LogOptions(viewer=options.viewer).check_viewer()
    reel = Reel(read_runs(folder))
    sending = open_sending(options, registry, reel.run)
    with ExitStack() as stack:
        stop = stack.enter_context(until_stopped(over))
        stack.enter_context(sending)
        show = _viewer(stack, reel, options.viewer)
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


def _viewer(stack: ExitStack, reel: Reel, address: str | None) -> Callable[[int], None]:
    """What shows a frame set in a viewer; nothing without one."""
    if address is None:
        return lambda _: None
    from measure.viewing.recording import RunRecording, open_recording

    run = reel.run
    names = [body.name for body in run.bodies]
    stream = open_recording(run.name, run.cameras, address=address, bodies=names)
    log = stack.enter_context(RunRecording(stream, run.bodies, run.cameras, 0, live=True))
    return lambda number: log.add(reel.measurements(number))


class Reel:
    """All that is played of a run."""

    def __init__(self, runs: Sequence[Run]) -> None:
        first = runs[0]
        if not first.poses.num_rows:
            raise RunError(f"{first.path} holds no frame set to play")
        self.times_s, self._runs, reference = first.times_s, runs, ""
        self._tracks = [_PlayedBody(run.poses, run.body.name) for run in runs]
        if not is_missing(first.path, "relative"):
            table = first.relative()
            pairs = zip(table[BODY].to_pylist(), table["reference"].to_pylist(), strict=True)
            for name, reference in dict.fromkeys(pairs):
                self._tracks.append(_PlayedBody(rows_of_body(table, name), name, reference))
        bodies = tuple(run.body for run in runs)
        self._marks = sorted(events(first.path))
        self.run = SentRun(first.path.resolve().name, bodies, first.cameras, reference)

    @cached_property
    def _balls(self) -> list[dict[int, list[BallPosition]]]:
        """The positions of each body's balls by frame set."""
        out: list[dict[int, list[BallPosition]]] = []
        for run in self._runs:
            out.append(defaultdict(list))
            for row in run.balls.to_pylist():
                center = np.array([row[axis] for axis in PLACE[:3]])
                spread = np.reshape(row["covariance_mm2"], (3, 3))
                ball = BallPosition(
                    row["ball"],
                    row["time_s"],
                    center,
                    spread,
                    cameras=tuple(row["cameras"]),
                    residuals_mm=np.zeros(0),
                )
                out[-1][row["index"]].append(ball)
        return out

    def poses(self, number: int, exposed_s: float, known_s: float) -> list[SentPose]:
        """The poses of a frame set."""
        return [track.sent(number, exposed_s, known_s) for track in self._tracks]

    def marks(self, number: int, exposed_s: float, rate: float) -> list[EventMark]:
        """The event marks since the frame set before."""
        before_s = self.times_s[number - 1] if number else -math.inf
        now_s = float(self.times_s[number])
        return [
            EventMark(time_s, exposed_s + (time_s - now_s) / rate, what)
            for time_s, what in self._marks
            if before_s < time_s <= now_s
        ]

    def measurements(self, number: int) -> list[Measurement]:
        """The measurements of a frame set, without what its pictures showed."""
        sent = [track.sent(number, 0.0, 0.0) for track in self._tracks]
        return [
            Measurement(
                *(one.frame, one.time_s, {}, (), tuple(balls[one.frame]), one.pose),
                status=Status(one.status),
                reason=one.reason,
            )
            for one, balls in zip(sent, self._balls, strict=False)
        ]


class _PlayedBody:
    """The stored poses of a body, perhaps relative to another."""

    def __init__(self, table: pa.Table, body: str, reference: str = "") -> None:
        self._body, self._reference = body, reference
        self._rows = table.drop_columns([*PLACE, "covariance"]).to_pylist()
        self._places = numbers(table, *PLACE)
        self._covariances = matrices(table, "covariance", 6)

    def sent(self, number: int, exposed_s: float, known_s: float) -> SentPose:
        """The pose of a frame set."""
        row, place = self._rows[number], self._places[number]
        pose = None
        if np.isfinite(place[0]):
            pose = Pose(
                row["time_s"],
                RigidTransform.from_quat_wxyz(place[3:], place[:3]),
                self._covariances[number],
                row["residual_mm"],
                row["rms_px"],
                tuple(row["cameras"]),
                tuple(row["balls"]),
                tuple(row["flags"]),
            )
        return SentPose(
            self._body,
            self._reference,
            row["index"],
            row["time_s"],
            exposed_s=exposed_s,
            known_s=known_s,
            status=row["status"],
            reason=row["reason"],
            pose=pose,
        )
