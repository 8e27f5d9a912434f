"""A rig's cameras, each read in a thread of its own."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from measure.errors import CaptureError
from measure.model import Image
from measure_studio.capture.controls import DeviceControls
from measure_studio.capture.device_clock import DeviceClock
from measure_studio.capture.outages import Outage, OutageWatch
from measure_studio.capture.sources import (
    PATIENCE_S,
    POLL_S,
    RECENT,
    RETRY_S,
    Shot,
    Source,
    image_of,
    is_whole,
    size_wh,
)

SETTLING_S = 1.0  # Pictures of a camera's first second are discarded, see `Source.settles`
_FIRST_PICTURE_S = 15.0  # Longest wait for the first picture of every camera


@dataclass(frozen=True)
class CameraCount:
    """What came of a camera."""

    pictures: int = 0  # handed on, from `Cameras.begin` on
    first_s: float = float("nan")  # time of the first of them; NaN without
    last_s: float = float("nan")  # and of the last
    own_clock: bool = False  # whether its times are of its own clock, not those of arrival
    # how much the steps from picture to picture vary, of late (a standard deviation by their median
    # distance from the median); NaN where unknown.
    uneven_s: float = float("nan")
    refused: int = 0  # pictures that could not be used: out of order, or no pictures
    outages: tuple[Outage, ...] = ()
    ended: bool = False  # whether it delivers no more: a file that is over

    @property
    def rate_hz(self) -> float:
        """Pictures a second; NaN if there are not two."""
        if self.pictures < 2 or not self.last_s > self.first_s:
            return float("nan")
        return (self.pictures - 1) / (self.last_s - self.first_s)


class Cameras:
    """Reads all cameras of a rig at once; use it in a `with` block.

    Entering it waits until each has delivered; what they deliver from `begin` on is handed on, so
    that all begin together. A camera that breaks off after that is connected anew, for as long as
    it takes; the others go on.
    """

    def __init__(
        self,
        sources: Mapping[str, Source],
        sizes_wh: Mapping[str, tuple[int, int]] | None = None,
        on_outage: Callable[[Outage], None] | None = None,
    ) -> None:
        """Make one; nothing is opened yet.

        Args:
            sizes_wh: what their pictures must measure; what the first does, where not given.
            on_outage: called, from a thread of its own, when a camera is away, and when it is back.
        """
        self._watch, self._on_outage = OutageWatch(sources), on_outage
        self._sizes = {name: tuple(size) for name, size in (sizes_wh or {}).items()}
        self._first_sizes: dict[str, tuple[int, int]] = {}
        self._sinks: tuple[Callable[[Image], None], ...] = ()
        self._sources = dict(sources)
        self._counts = dict.fromkeys(sources, CameraCount())
        self._ready = {name: threading.Event() for name in sources}
        self._go, self._stop = threading.Event(), threading.Event()
        self._failed: list[BaseException] = []
        self._since_1970 = time.time() - time.monotonic()
        self._threads = [
            threading.Thread(target=self._work, args=(name,), daemon=True, name=f"camera {name}")
            for name in sources
        ]
        self._threads.append(threading.Thread(target=self._look, daemon=True, name="outages"))

    def __enter__(self) -> Self:
        begun = time.monotonic()
        for source in self._sources.values():
            source.begin_at(begun)
        try:
            for thread in self._threads:
                thread.start()
            self._wait_for_all(begun + _FIRST_PICTURE_S)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.wait()

    def begin(self, sinks: Sequence[Callable[[Image], None]]) -> None:
        """Call `sinks` with every picture from now on, in order, from each camera's thread."""
        self._sinks = tuple(sinks)
        self._watch.begin(self.clock_s())
        self._go.set()

    @property
    def addresses(self) -> dict[str, str]:
        """By camera, where its pictures come from, as it may be shown."""
        return {name: source.address for name, source in self._sources.items()}

    @property
    def controls(self) -> dict[str, DeviceControls]:
        """Those of each camera that has some here."""
        return {name: one.controls for name, one in self._sources.items() if one.controls}

    @property
    def counts(self) -> dict[str, CameraCount]:
        """What came of each camera so far."""
        return {
            name: replace(count, outages=self._watch.of(name))
            for name, count in self._counts.items()
        }

    @property
    def away(self) -> tuple[str, ...]:
        """The cameras that are away now."""
        return self._watch.away

    def note_read(self, name: str, readable: bool) -> None:
        """Hear whether a picture that was handed on could be decoded."""
        self._watch.read(name, readable)

    def note_copies(self, names: Iterable[str], copies: Mapping[str, str]) -> None:
        """Take the cameras whose pictures were measured, and which showed another's."""
        for name in {*names, *copies}:
            self._watch.compare(name, copies.get(name, ""))

    @property
    def over(self) -> bool:
        """Whether none delivers any more."""
        return self._stop.is_set() or all(one.ended for one in self._counts.values())

    def clock_s(self) -> float:
        """The time now, on the clock of the pictures."""
        return time.monotonic() + self._since_1970

    def stop(self) -> None:
        """Let no camera deliver any more."""
        self._stop.set()
        self._go.set()

    def wait(self) -> None:
        """After `stop`, wait until nothing is handed on; not for long if a camera hangs."""
        until_s = time.monotonic() + PATIENCE_S
        while self._threads:
            self._threads.pop().join(max(until_s - time.monotonic(), 0.0))

    def check(self) -> None:
        """Raise what went wrong in a camera's thread and cannot be waited out, if anything did."""
        if self._failed:
            raise self._failed[0]

    def _wait_for_all(self, until_s: float) -> None:
        for name, ready in self._ready.items():
            while not ready.wait(0.05):
                self.check()
                if time.monotonic() > until_s:
                    raise CaptureError(
                        f"camera '{name}': {self._sources[name].address}: no whole picture "
                        f"in {_FIRST_PICTURE_S:g} s"
                    )
        self.check()

    def _work(self, name: str) -> None:
        """One camera's thread."""
        source = self._sources[name]
        try:
            while not self._stop.is_set():
                try:
                    self._read(name, source)
                except CaptureError as problem:
                    self._broke_off(name, problem)
                else:
                    if source.lasting and not self._stop.is_set():
                        self._broke_off(name, CaptureError(f"{source.address}: the stream ended"))
                if not source.lasting:
                    break
                self._stop.wait(RETRY_S)
        except BaseException as problem:
            self._failed.append(problem)  # raised again by `check`
        self._watch.end(name)
        self._note(name, ended=True)

    def _look(self) -> None:
        """The thread that tells which cameras are away."""
        self._go.wait()
        while not self._stop.wait(POLL_S):
            for outage in self._watch.look():
                if self._on_outage is not None:
                    self._on_outage(outage)

    def _broke_off(self, name: str, problem: CaptureError) -> None:
        """Go on after a while, unless it never worked."""
        if not self._ready[name].is_set():
            raise CaptureError(f"camera '{name}': {problem}") from None
        self._watch.fail(name, str(problem))

    def _read(self, name: str, source: Source) -> None:
        """Hand on what a source delivers, until it ends or is to stop."""
        clock, connected, last_s = DeviceClock(), time.monotonic(), self._counts[name].last_s
        steps: deque[float] = deque(maxlen=RECENT)
        last_jpeg: bytes | None = None
        for shot in source.shots():
            if self._stop.is_set():
                return
            time_s = clock.time_s(shot.arrived_s, shot.device_s) + self._since_1970
            whole = is_whole(shot)
            if whole:
                self._check_size(name, shot)
            if source.settles and time.monotonic() - connected < SETTLING_S:
                continue
            if whole or not source.settles:
                self._ready[name].set()
            if source.settles and not self._go.is_set():
                continue
            self._go.wait()
            if self._stop.is_set():
                return
            if time_s <= last_s or not whole:
                self._note(name, refused=self._counts[name].refused + 1)
                self._watch.fail(name, "its pictures are torn or out of order")
                continue
            own_clock = source.keeps_time or (clock.runs and shot.device_s is not None)
            sd_s = 0.0 if source.keeps_time else clock.sd_s
            steps.append(time_s - last_s)
            last_s = time_s
            if shot.jpeg is not None and shot.jpeg == last_jpeg:
                self._watch.fail(name, "its picture does not change")
            else:
                self._watch.came(name, time_s, own_clock)
            last_jpeg = shot.jpeg
            self._deliver(name, shot, time_s, sd_s)
            self._note(name, uneven_s=_uneven_s(steps), own_clock=own_clock)

    def _deliver(self, name: str, shot: Shot, time_s: float, time_sd_s: float) -> None:
        count = self._counts[name]
        image = image_of(name, count.pictures, time_s, shot, time_sd_s)
        try:
            for sink in self._sinks:
                sink(image)
        except BaseException as problem:  # no camera's fault: none is of use without its sink
            self._failed.append(problem)
            self.stop()
            return
        first_s = time_s if not count.pictures else count.first_s
        self._note(name, pictures=count.pictures + 1, first_s=first_s, last_s=time_s)

    def _note(self, name: str, **changed: object) -> None:
        """Only a camera's own thread changes its count."""
        self._counts[name] = replace(self._counts[name], **changed)  # type: ignore[arg-type]

    def _check_size(self, name: str, shot: Shot) -> None:
        """Refuse pictures that are not of the calibrated size, or the first one's."""
        size, wanted = size_wh(shot), self._sizes.get(name)
        if size is None or size == wanted:
            return
        found = f"{self._sources[name].address}: its pictures are {size[0]}x{size[1]} px"
        if wanted is None:
            self._first_sizes.setdefault(name, size)
            if (first := self._first_sizes[name]) != size:
                raise CaptureError(f"{found}, and its first were {first[0]}x{first[1]} px")
            return
        raise CaptureError(
            f"{found}, and {wanted[0]}x{wanted[1]} px is what is calibrated: set the camera to "
            "that size, or calibrate it at this one"
        )


def _uneven_s(steps: Sequence[float]) -> float:
    known = np.array([step for step in steps if not math.isnan(step)])
    return 1.5 * float(np.median(np.abs(known - np.median(known)))) if len(known) else math.nan
