"""A session's cameras played as web cameras, into whatever reads such."""

from __future__ import annotations

import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import MeasureError
from measure.processes import until_stopped
from measure.session import Stream, open_streams
from measure_studio.api.playing import Pace
from measure_studio.capture import jpeg_of, picture_part, serve_cameras

CAMERA_PORT = 8090  # Where cameras are served if nothing else is asked for
_STALE_S = 1.0  # Pictures that are later than this are passed over: their reader is too slow
_LINGER_S = 1.0  # How long readers may still take what came last


@dataclass(frozen=True, eq=False)
class PictureReel:
    """Pictures of cameras, and when the turn of each comes."""

    streams: Mapping[str, Stream]
    # by camera, when pictures have their turn (n,), s since the beginning, and their places (n,) in
    # the stream.
    turns: Mapping[str, tuple[Floats, Ints]]
    lasts_s: float  # then it may begin again

    @classmethod
    def of_session(cls, streams: Mapping[str, Stream]) -> PictureReel:
        """A recording, at its own stamps."""
        first = min(float(stream.times_s[0]) for stream in streams.values())
        last = max(float(stream.times_s[-1]) for stream in streams.values())
        periods = [stream.period_s for stream in streams.values() if len(stream) > 1]
        turns = {n: (one.times_s - first, np.arange(len(one))) for n, one in streams.items()}
        return cls(streams, turns, last - first + min(periods, default=1.0))


class Screening:
    """A reel that is shown to every reader of its cameras at the same pace.

    Args:
        reel: what is shown.
        rate: how many times as fast as it was recorded.
        loop: it has begun, and begins again at its end; else it is shown once, from `wait_s` after
            the first reader came.
    """

    def __init__(
        self, reel: PictureReel, rate: float = 1.0, loop: bool = True, wait_s: float = 0.0
    ) -> None:
        self._reel, self._rate, self._loop, self._wait_s = reel, rate, loop, wait_s
        self._begun_s = time.monotonic() if loop else None
        self._turn = threading.Lock()
        self.over = threading.Event()
        self.sent = dict.fromkeys(reel.streams, 0)  # pictures, to all readers

    def parts(self, camera: str) -> Iterator[bytes]:
        """A camera's pictures from now on, with their stamps on this machine's steady clock."""
        begun_s, stream = self._begin(), self._reel.streams[camera]
        for due_s, place in self._turns(camera, time.monotonic() - begun_s):
            wait_s = begun_s + due_s - time.monotonic()
            if wait_s < -_STALE_S:
                continue
            if self.over.wait(max(wait_s, 0.0)):
                return
            try:
                data = jpeg_of(stream.read(place))
            except MeasureError:
                continue  # a picture that cannot be read is missing, as of any camera
            yield picture_part(data, begun_s + due_s)
            self.sent[camera] += 1

    def wait(self, stop: threading.Event) -> None:
        """Wait until it has been shown, or `stop` is set."""
        lasts_s = self._reel.lasts_s / self._rate + _LINGER_S
        while not stop.wait(0.1):
            begun_s = self._begun_s
            if not self._loop and begun_s is not None and time.monotonic() - begun_s > lasts_s:
                break
        self.over.set()

    def _begin(self) -> float:
        with self._turn:
            if self._begun_s is None:
                self._begun_s = time.monotonic() + self._wait_s
            return self._begun_s

    def _turns(self, camera: str, since_s: float) -> Iterator[tuple[float, int]]:
        """When pictures have their turn from `since_s` on, s since the beginning, and places."""
        times_s, places = self._reel.turns[camera]
        times_s, lasts_s = times_s / self._rate, self._reel.lasts_s / self._rate
        round_ = max(int(since_s / lasts_s), 0)
        while True:
            for time_s, place in zip(times_s.tolist(), places.tolist(), strict=True):
                due_s = round_ * lasts_s + time_s
                if due_s >= since_s:
                    yield due_s, place
            if not self._loop:
                return
            round_ += 1


def play_cameras(
    session: Path,
    pace: Pace,
    port: int = CAMERA_PORT,
    tell: Callable[[str], None] = print,
    over: threading.Event | None = None,
) -> dict[str, int]:
    """Serve a session's cameras to this machine, as motion JPEG over HTTP at their own stamps.

    Pictures that were recorded as JPEG are sent as they are. Without `pace.loop` the session
    begins `pace.wait_s` after the first reader came, and it ends with the session; otherwise
    when interrupted or when `over` is set.

    Args:
        port: to listen on; 0 for any that is free.
        tell: called with the cameras as NAME=ADDRESS, as `measure live` and `record` take them.

    Returns:
        The number of pictures sent by camera.

    Raises:
        MeasureError: the folder is no session, an option is wrong, or the port is not free.
    """
    pace.check_pace()
    with open_streams(session) as streams:
        shown = Screening(PictureReel.of_session(streams), pace.rate, pace.loop, pace.wait_s)
        feeds = {name: partial(shown.parts, name) for name in streams}
        with until_stopped(over) as stop, serve_cameras(feeds, port) as addresses:
            tell(camera_line(addresses))
            shown.wait(stop)
    return shown.sent


def camera_line(addresses: Mapping[str, str]) -> str:
    """Cameras as they are typed in a shell."""
    return " ".join(shlex.quote(f"{name}={address}") for name, address in addresses.items())
