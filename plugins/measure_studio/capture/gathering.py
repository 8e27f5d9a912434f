"""Frame sets from pictures as they come: none waits long for a camera that is late."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import median

from measure.errors import MeasureError
from measure.limits import GAP_PERIODS
from measure.model import FrameSet, Image
from measure_studio.capture.sources import POLL_S, RECENT

_REACH_PERIODS = 0.75
"""Largest distance of a set's pictures from its middle one, in periods. With half a period, cameras
that expose just between two others would be lost at random."""
_FIRST_PERIOD_S = 0.1  # Period assumed before any interval is known
_MAX_WAITING = 16  # Pictures of a camera that wait at a time, however slowly sets are taken
_SILENT_PERIODS = 4  # A camera silent for so many of its periods is not waited for


class Gathering:
    """Pictures of all cameras go in from their threads, frame sets come out in order of time.

    A set is made as soon as every camera has delivered that should have, or when its first picture
    has waited for one and a half periods; pictures belong to it that are no further than three
    quarters of a period from its middle one. What has been overtaken is left out: a set is the
    newest there is, and none is older than the one before.

    Attributes:
        overtaken: how many pictures of the camera that lost most were left out for newer ones.
    """

    def __init__(
        self,
        names: Sequence[str],
        clock: Callable[[], float] = time.monotonic,
        on_read: Callable[[str, bool], None] = lambda *_: None,
    ) -> None:
        """Make one.

        Args:
            clock: tells, in s, how long pictures wait.
            on_read: called with a camera's name, and whether its picture could be decoded.
        """
        self._clock, self._on_read = clock, on_read
        self._waiting: dict[str, deque[tuple[float, Image]]] = {
            name: deque(maxlen=_MAX_WAITING) for name in names
        }
        self._steps: dict[str, deque[float]] = {name: deque(maxlen=RECENT) for name in names}
        self._last_s: dict[str, float] = {}
        self._begun_s = 0.0
        self._reached_s = -math.inf
        self._left = dict.fromkeys(names, 0)
        self._changed = threading.Condition()
        self.unreadable = 0

    @property
    def overtaken(self) -> int:
        """See the class."""
        return max(self._left.values())

    def add(self, image: Image) -> None:
        """Hand in a picture; each camera's in order."""
        name = image.camera
        with self._changed:
            if not self._last_s:
                self._begun_s = image.time_s
            if name in self._last_s:
                self._steps[name].append(image.time_s - self._last_s[name])
            self._last_s[name] = image.time_s
            if image.time_s <= self._reached_s:  # held up so long that its set is made
                self._left[name] += 1
                return
            self._left[name] += len(self._waiting[name]) == _MAX_WAITING
            self._waiting[name].append((self._clock(), image))
            self._changed.notify()

    def frame_sets(
        self, over: Callable[[], bool], check: Callable[[], None] = lambda: None
    ) -> Iterator[FrameSet]:
        """Yield frame sets, decoded, until `over` and none is left; what was left out counts anew.

        Args:
            over: whether no camera delivers any more.
            check: called now and then; what it raises ends this.
        """
        index = self.unreadable = 0
        with self._changed:
            self._left = dict.fromkeys(self._left, 0)
        with ThreadPoolExecutor(len(self._waiting), thread_name_prefix="decode") as pool:
            while True:
                check()
                ended = over()
                taken = self.take(ended)
                if not taken:
                    if ended:
                        return
                    self._wait()
                    continue
                decoded = list(pool.map(_decoded, taken))
                for one, image in zip(taken, decoded, strict=True):
                    self._on_read(one.camera, image is not None)
                images = [image for image in decoded if image is not None]
                self.unreadable += len(taken) - len(images)
                if images:
                    named = {image.camera: image for image in images}
                    yield FrameSet(index, _middle_s(images), named)
                    index += 1

    def take(self, ended: bool = False) -> list[Image]:
        """The pictures of the next set; none while it is not ready, or `ended` and none left."""
        with self._changed:
            members = self._members() if self._is_ready(ended) else []
            if members:
                self._reached_s = _middle_s(members)
            return members

    def _wait(self) -> None:
        """Wait for a picture, but not so long that one waits for another in vain."""
        with self._changed:
            if not self._is_ready(ended=False):
                self._changed.wait(min(POLL_S, self._period_s() / 2))

    def _is_ready(self, ended: bool) -> bool:
        """Whether there are pictures to make a set of, and none worth waiting for."""
        firsts = [waiting[0] for waiting in self._waiting.values() if waiting]
        if not firsts:
            return False
        until_s = max(image.time_s for _, image in firsts) + _REACH_PERIODS * self._period_s()
        if ended or not any(self._is_due(name, until_s) for name in self._waiting):
            return True
        since = min(put for put, _ in firsts)
        return self._clock() - since > GAP_PERIODS * self._period_s()

    def _is_due(self, name: str, until_s: float) -> bool:
        """Whether a camera without a waiting picture should have taken one until then."""
        if self._waiting[name]:
            return False
        steps = self._steps[name]
        step_s = median(steps) if steps else self._period_s()
        last_s = self._last_s.get(name, self._begun_s - step_s)
        return last_s + step_s <= until_s <= last_s + _SILENT_PERIODS * step_s

    def _period_s(self) -> float:
        """Of the fastest camera."""
        known = (median(steps) for steps in self._steps.values() if steps)
        return min(known, default=_FIRST_PERIOD_S)

    def _members(self) -> list[Image]:
        """One picture a camera, about the newest instant that all have reached."""
        period_s = self._period_s()
        newest = [waiting[-1][1].time_s for waiting in self._waiting.values() if waiting]
        late_s = max(newest) - GAP_PERIODS * period_s
        reached = min(time_s for time_s in newest if time_s >= late_s)
        for name, waiting in self._waiting.items():
            while len(waiting) > 1 and _is_nearer(waiting[1][1], waiting[0][1], reached):
                self._leave(name)
        firsts = sorted(waiting[0][1].time_s for waiting in self._waiting.values() if waiting)
        middle = firsts[(len(firsts) - 1) // 2]
        reach_s, out = _REACH_PERIODS * period_s, []
        for name, waiting in self._waiting.items():
            if waiting and waiting[0][1].time_s < middle - reach_s:
                self._leave(name)
            if waiting and waiting[0][1].time_s <= middle + reach_s:
                out.append(waiting.popleft()[1])
        return out

    def _leave(self, name: str) -> None:
        self._waiting[name].popleft()
        self._left[name] += 1


def _middle_s(images: Sequence[Image]) -> float:
    return sum(image.time_s for image in images) / len(images)


def _is_nearer(one: Image, other: Image, instant_s: float) -> bool:
    return abs(one.time_s - instant_s) < abs(other.time_s - instant_s)


def _decoded(image: Image) -> Image | None:
    """A picture whose pixels are there; None for one that cannot be read."""
    try:
        _ = image.pixels
    except MeasureError:
        return None
    return image
