"""A rig's cameras, each read in a thread of its own; their clocks, and when they are away.

A camera's own clock is brought to ours. An outage is reported at once, once, and again at its end.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median  # of the few numbers of each picture, faster than an array's
from typing import Self

import numpy as np

from measure.arrays import Floats
from measure.errors import CaptureError
from measure.model import Image
from measure_studio.capture.devices import DeviceControls
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

_WINDOW_S = 30.0
"""Delays older than this are dropped: clocks drift by tens of microseconds a second."""
_JUMP_S = 1.0  # A clock that is off by so much more than before has been set anew
_HELD_UP_S = 5.0  # Pictures that are later than that for a shorter time were held up by the network
_MAX_RESTARTED_SHARE = 0.1
"""Share of pictures at which a clock may be set anew; one that stands still, or does not count
seconds, is at every picture."""


class Arrivals:
    """How late pictures arrive, against the rate of their camera: of late, the least late are not.

    A camera exposes evenly, so that what its pictures are off an even row is the network's or a
    busy machine's. One that changes its rate is taken to be late until the new rate is known.
    """

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=RECENT)

    def add(self, arrived_s: float) -> None:
        """A picture arrived."""
        self._at_s.append(arrived_s)

    def lateness_s(self) -> Floats:
        """(n,) of the latest pictures, oldest first; zeros as long as there are too few."""
        steps = np.diff(self._at_s)
        period_s = float(np.median(steps)) if len(steps) else 0.0
        if len(steps) < 2 or period_s <= 0:
            return np.zeros(len(self._at_s))
        numbers = np.concatenate([[0.0], np.cumsum(_periods(steps / period_s))])
        off_s = np.array(self._at_s) - self._at_s[0] - period_s * numbers
        # The median step is off by its error; medians of both halves show by how much, whatever
        # some late ones do.
        half = len(off_s) // 2
        rise_s = np.median(off_s[half:]) - np.median(off_s[:half])
        off_s -= numbers * rise_s / (numbers[half:].mean() - numbers[:half].mean())
        return off_s - off_s.min()


def _periods(steps: Floats) -> Floats:
    """How many periods of their camera (n,) lie between pictures that arrived so many (n,) apart.

    What was held up arrives with those that follow it, after which no picture is missing. The last
    long step may be either: until it is known, its picture is taken to be late.
    """
    out = np.ones(len(steps))
    firsts = np.flatnonzero(steps >= 0.5)  # the others came at once after the one before them
    for first, end in pairwise(firsts):
        missing = np.rint(steps[first:end].sum()) - (end - first)
        out[first] += max(missing, 0.0)
    return out


class DeviceClock:
    """When pictures were taken, from when they arrived and what the camera's clock says.

    A camera's clock runs evenly, but from a start of its own; pictures arrive on our clock, but
    late by what it takes to read them out, compress and send them, which varies. The least delay of
    late ties one to the other (as in the clock filter of RFC 5905). What every picture takes at
    least stays: a constant, about the same for cameras of one kind; `measure refine`
    finds by how much they differ.

    Attributes:
        sd_s: standard deviation of the last reported time: what its picture is late against
            the camera's rate, if it is the time of arrival, and at least what is usual; with a
            clock that was just set anew, what the least late one since was.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()
        self._start_s = self._last_s = 0.0
        self._late_since_s: float | None = None
        self._stamps = self._anew = 0
        self._arrivals, self._tied_sd_s, self.sd_s = Arrivals(), 0.0, 0.0

    @property
    def runs(self) -> bool:
        """Whether times of stamps are the camera's: its clock runs as ours does."""
        return self._stamps > 0 and self._anew <= _MAX_RESTARTED_SHARE * self._stamps

    def time_s(self, arrived_s: float, device_s: float | None) -> float:
        """The time of a picture, s on our clock.

        Args:
            arrived_s: when it had arrived, on our clock.
            device_s: its stamp on the camera's clock; without one it is taken when it arrived.
        """
        self._arrivals.add(arrived_s)
        if device_s is None:
            self.sd_s = self._arrival_sd_s()
            return arrived_s
        self._stamps += 1
        since_s, least = device_s - self._start_s, self._least
        late = arrived_s - since_s
        if not least or since_s <= self._last_s or self._is_set_anew(arrived_s, late):
            self._anew += bool(least)
            least.clear()
            # From here on, for whatever clocks count from would cost digits.
            self._start_s, since_s, late, self._late_since_s = device_s, 0.0, arrived_s, None
            self._tied_sd_s = math.inf
        self._last_s = since_s
        while least and least[-1][1] >= late:
            least.pop()
        least.append((since_s, late))
        while least[0][0] < since_s - _WINDOW_S:
            least.popleft()
        if self._tied_sd_s:
            self._tied_sd_s = min(self._tied_sd_s, float(self._arrivals.lateness_s()[-1]))
        self.sd_s = self._tied_sd_s if self.runs else self._arrival_sd_s()
        return since_s + least[0][1]

    def _arrival_sd_s(self) -> float:
        lateness_s = self._arrivals.lateness_s()
        return float(max(lateness_s[-1], np.median(lateness_s)))

    def _is_set_anew(self, arrived_s: float, late: float) -> bool:
        """Whether the clock was set: at once where it is ahead, after a while where it is behind.

        What a network holds up seems behind too, but only until it has all come.
        """
        behind = late - self._least[0][1]
        if behind <= _JUMP_S:
            self._late_since_s = None
            return behind < -_JUMP_S
        if self._late_since_s is None:
            self._late_since_s = arrived_s
        return arrived_s - self._late_since_s > _HELD_UP_S


_MISSING = 3  # A camera is away when so many of its pictures in a row have not come
_GRACE_S = 0.5
"""How much later than due the last of them may come: networks and busy machines hold some up."""
_STEADY_S = 1.0
"""A camera is back once pictures have come for so long: one that stutters is away once."""
_STEPS = 16  # Latest steps from picture to picture whose median is a camera's period
_FIRST_PERIOD_S = 0.5  # Period assumed before any step is known
_LISTED = 1000  # Outages of a camera that are listed; of more, the latest


@dataclass(frozen=True)
class Outage:
    """A time in which a camera delivered no new picture."""

    camera: str
    since_s: float  # time of the last picture before, in seconds since 1970
    until_s: float = math.nan  # time of the first picture after; NaN while it lasts
    reason: str = "no picture came"

    @property
    def lasts(self) -> bool:
        """Whether the camera is still away."""
        return math.isnan(self.until_s)

    def sentence(self) -> str:
        """For people."""
        if self.lasts:
            return f"{self.camera} is away: {self.reason}"
        return f"{self.camera} is back after {self.until_s - self.since_s:.1f} s ({self.reason})"


@dataclass
class _Attendance:
    """What is known of a camera: times on our clock (`heard_s`) and the pictures' (`time_s`)."""

    heard_s: float = math.inf
    time_s: float = math.nan
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_STEPS))
    outage: Outage | None = None
    reported: bool = False
    back_s: float = math.inf
    back_time_s: float = math.nan
    trouble: str = ""
    # how many pictures in a row are of no use, by who found that.
    spoiled: Counter[str] = field(default_factory=Counter)
    past: deque[Outage] = field(default_factory=lambda: deque(maxlen=_LISTED))

    @property
    def period_s(self) -> float:
        return median(self.steps) if self.steps else _FIRST_PERIOD_S

    @property
    def is_spoiled(self) -> bool:
        return max(self.spoiled.values(), default=0) >= _MISSING

    @property
    def away(self) -> bool:
        return self.outage is not None and math.isinf(self.back_s)


class OutageWatch:
    """Notices which cameras are away; the cameras' threads report pictures to it."""

    def __init__(self, names: Iterable[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._cameras = {name: _Attendance() for name in names}
        self._begun_s = math.nan

    @property
    def away(self) -> tuple[str, ...]:
        """The cameras whose pictures are missing now."""
        return tuple(name for name, one in self._cameras.items() if one.away)

    def of(self, name: str) -> tuple[Outage, ...]:
        """A camera's outages, the present one included."""
        one = self._cameras[name]
        with self._lock:
            lasting = () if one.outage is None else (_explained(one.outage, one),)
            return (*one.past, *lasting)

    def begin(self, time_s: float) -> None:
        """From now on all are expected to deliver; `time_s` is now, on the pictures' clock."""
        with self._lock:
            self._begun_s = time_s
            for one in self._cameras.values():
                one.heard_s = self._clock()

    def end(self, name: str) -> None:
        """No more is expected of this camera."""
        self._cameras[name].heard_s = math.inf

    def came(self, name: str, time_s: float, exact: bool) -> None:
        """A new picture of a camera came.

        Args:
            exact: whether that is of the camera's own clock. Then a step of several periods means
                that pictures are missing, otherwise that they may have been held up.
        """
        one, now = self._cameras[name], self._clock()
        with self._lock:
            step_s = time_s - one.time_s
            if exact and step_s > (_MISSING + 0.5) * one.period_s:
                self._miss(name, one)
            if one.outage is not None and math.isinf(one.back_s) and not one.is_spoiled:
                one.back_s, one.back_time_s = now, time_s
            if not math.isnan(step_s):
                one.steps.append(step_s)
            one.heard_s, one.time_s = now, time_s
            if one.outage is None:
                one.trouble = ""

    def fail(self, name: str, reason: str) -> None:
        """A camera broke off, or delivers what cannot be used."""
        self._cameras[name].trouble = reason

    def read(self, name: str, readable: bool) -> None:
        """A picture of a camera was decoded, or could not be; three in a row are missing."""
        self._judge(name, "decoding", "" if readable else "its pictures cannot be decoded")

    def compare(self, name: str, whose: str) -> None:
        """A picture of a camera was its own (`whose` is empty), or another camera's."""
        self._judge(name, "comparing", f"it shows the pictures of {whose}" if whose else "")

    def _judge(self, name: str, by: str, trouble: str) -> None:
        one = self._cameras[name]
        with self._lock:
            one.spoiled[by] = one.spoiled[by] + 1 if trouble else 0
            if one.spoiled[by] >= _MISSING:
                one.trouble = trouble
                self._miss(name, one)

    def look(self) -> list[Outage]:
        """What has changed since the last look: outages that began, and those that ended."""
        now, changed = self._clock(), list[Outage]()
        with self._lock:
            for name, one in self._cameras.items():
                if now - one.heard_s > _MISSING * one.period_s + _GRACE_S:
                    self._miss(name, one)
                if one.outage is not None and not one.reported:
                    one.reported = True
                    changed.append(one.outage)
                if one.outage is not None and one.heard_s - one.back_s > _STEADY_S:
                    changed.append(self._end(one.outage, one))
        return changed

    def _miss(self, name: str, one: _Attendance) -> None:
        """Begin an outage, or let the present one go on."""
        if one.outage is None:
            since_s = self._begun_s if math.isnan(one.time_s) else one.time_s
            one.outage, one.reported = _explained(Outage(name, since_s), one), False
        one.back_s = math.inf

    def _end(self, outage: Outage, one: _Attendance) -> Outage:
        over = replace(_explained(outage, one), until_s=one.back_time_s)
        one.past.append(over)
        one.outage, one.back_s, one.trouble = None, math.inf, ""
        return over


def _explained(outage: Outage, one: _Attendance) -> Outage:
    return replace(outage, reason=one.trouble) if one.trouble else outage


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
    known = [step for step in steps if not math.isnan(step)] or [math.nan]
    middle = median(known)
    return 1.5 * median(abs(step - middle) for step in known)
