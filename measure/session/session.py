"""A recording: cameras with their frames and times, the body, and what else belongs to it."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np

from measure.errors import SessionError
from measure.model import Body, Camera, FrameSet, Image
from measure.session.pairing import Pairing, pair_nearest, seldom_paired
from measure.session.streams import Stream

DEFAULT_PREFETCH = 3  # Frame sets decoded ahead of the one in use


@dataclass(frozen=True, eq=False)
class Session:
    """An opened recording; use it in a `with` block, or call `close`."""

    name: str  # as the file says, else the folder's name
    path: Path
    body: Body  # what is measured; the first of several
    cameras: tuple[Camera, ...]  # calibrated, in the order of the session
    streams: dict[str, Stream]
    calibration_path: Path  # the file the cameras come from
    truth_path: Path | None = None  # the known poses, if there are any; only evaluation reads them
    robot_log: Path | None = None  # the robot's log, if there is one
    description: str = ""
    # what a user should know: missing frames and the like.
    notes: tuple[str, ...] = field(default=())
    clock_digest: str = ""  # a fingerprint of the stamps as they were recorded
    # by camera, what a calibration refined from these stamps has added to them.
    clock_shifts_s: Mapping[str, float] = field(default_factory=dict)
    other_bodies: tuple[Body, ...] = ()  # what else is measured
    reference: str = ""  # the body that others are measured relative to

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close open videos."""
        for stream in self.streams.values():
            stream.close()

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All that are measured."""
        return (self.body, *self.other_bodies)

    def camera(self, name: str) -> Camera:
        """The camera called `name`."""
        return next(camera for camera in self.cameras if camera.name == name)

    def digest(self) -> str:
        """A fingerprint: changes when the body, the clocks, or any picture's name or size does."""
        balls = [
            (b.name, b.color, b.center_mm.tolist(), b.radius_mm)
            for body in self.bodies
            for b in body.balls
        ]
        fingerprint = hashlib.sha256(repr(balls).encode())
        for stream in self.streams.values():
            sizes = [(file.name, file.stat().st_size) for file in stream.files]
            fingerprint.update(repr((stream.name, stream.size_wh, sizes)).encode())
            fingerprint.update(stream.frames.tobytes() + stream.times_s.tobytes())
        return fingerprint.hexdigest()

    def pair(self, tolerance_s: float | None = None, reference: str | None = None) -> Pairing:
        """Frames that form sets (see `pair_nearest`); SessionError if `reference` is no camera."""
        names = list(self.streams)
        if reference is not None and reference not in names:
            raise SessionError(f"no camera '{reference}'; there is {', '.join(names)}")
        return pair_nearest(
            [stream.times_s for stream in self.streams.values()],
            tolerance_s,
            None if reference is None else names.index(reference),
        )

    def clock_notes(self) -> tuple[str, ...]:
        """Cameras whose clock the pairing contradicts, a line each."""
        counts = [len(stream) for stream in self.streams.values()]
        return tuple(seldom_paired(list(self.streams), counts, self.pair()))

    def stamp_notes(self) -> tuple[str, ...]:
        """Cameras whose stamps show errors of their own, a line each."""
        streams = self.streams.items()
        return tuple(f"{name}: {note}" for name, s in streams for note in s.stamps.notes)

    def frame_sets(
        self,
        pairing: str = "nearest",
        tolerance_s: float | None = None,
        prefetch: int = DEFAULT_PREFETCH,
        start: int = 0,
        reference: str | None = None,
    ) -> Iterator[FrameSet]:
        """Stream the frame sets in order of time, decoded ahead, in bounded memory.

        Args:
            pairing: "nearest" (see `pair_nearest`).
            tolerance_s: largest distance of an image from the instant; half the reference camera's
                median period if omitted.
            prefetch: sets decoded ahead.
            reference: the camera whose clock sets the instants, to overrule the choice.

        Raises:
            SessionError: no two cameras have images close enough in time, or an image cannot be
                read (when its set is due).
        """
        if pairing != "nearest":
            raise SessionError(f"no pairing is called '{pairing}'; there is nearest")
        if tolerance_s is not None and not (np.isfinite(tolerance_s) and tolerance_s >= 0):
            raise SessionError(f"the pairing tolerance must not be negative, got {tolerance_s} s")
        paired = self.pair(tolerance_s, reference)
        if not np.any((paired.positions >= 0).sum(axis=1) >= 2):
            raise SessionError(
                f"{self.path}: no two cameras have images within {paired.tolerance_s:.4g} s of "
                "each other; raise the tolerance or check the clocks"
            )
        return stream_frame_sets(list(self.streams.values()), paired, prefetch, start)


def stream_frame_sets(
    streams: Sequence[Stream], pairing: Pairing, prefetch: int = DEFAULT_PREFETCH, start: int = 0
) -> Iterator[FrameSet]:
    """Yield frame sets in order; at most `prefetch` + 1 sets are held here at any time.

    Each camera has a thread that reads its frames one after the other, as suits a video best.
    A picture that cannot be read raises when its own frame set is due, not earlier.

    Args:
        streams: in the order of the pairing's columns.
        prefetch: sets decoded ahead; 0 decodes nothing ahead and leaves pixels lazy.
    """
    if prefetch <= 0:
        for index in range(start, len(pairing.times_s)):
            images = {s.name: s.read(p) for s, p in _members(streams, pairing, index)}
            yield FrameSet(index, float(pairing.times_s[index]), images)
        return
    pools = {stream.name: ThreadPoolExecutor(1, "decode") for stream in streams}
    ahead: deque[tuple[int, dict[str, Future[Image]]]] = deque()
    due = iter(range(start, len(pairing.times_s)))
    try:
        while True:
            for index in islice(due, prefetch - len(ahead)):
                members = _members(streams, pairing, index)
                ahead.append(
                    (index, {s.name: pools[s.name].submit(_read, s, p) for s, p in members})
                )
            if not ahead:
                return
            index, futures = ahead.popleft()
            images = {name: future.result() for name, future in futures.items()}
            futures.clear()
            yield FrameSet(index, float(pairing.times_s[index]), images)
            del images
    finally:
        for pool in pools.values():
            pool.shutdown(cancel_futures=True)


def _members(
    streams: Sequence[Stream], pairing: Pairing, index: int
) -> Iterator[tuple[Stream, int]]:
    for stream, position in zip(streams, pairing.positions[index], strict=True):
        if position >= 0:
            yield stream, int(position)


def _read(stream: Stream, position: int) -> Image:
    image = stream.read(position)
    _ = image.pixels
    return image
