"""A recording: cameras, the body, and frames with times, paired to the sets of one instant."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import SessionError
from measure.limits import GAP_PERIODS
from measure.model import Body, Camera, FrameSet, Image
from measure.session.calibration_file import UNSTATED_SCALE_SD
from measure.session.damage import is_torn
from measure.session.streams import Stream


@dataclass(frozen=True, eq=False)
class Pairing:
    """Frame sets as positions in the streams."""

    positions: Ints  # (sets, cameras) position in each camera's stream, -1 for no image
    times_s: Floats  # (sets,) mean time of each set's images, increasing
    reference: int  # index of the camera whose clock set the instants
    tolerance_s: float  # the largest accepted distance from an instant


def pair_nearest(times_s: Sequence[Floats]) -> Pairing:
    """Pair images by nearest time.

    The instants are the stamps of the reference camera: the first whose median period is within 1 %
    of the median (of an even number the longer) of all cameras' periods, so that neither a slow
    camera thins the others out nor a fast one makes sets of its own. Instants it missed (gaps, and
    the time before it started or after it ended) are filled in at its period where at least two
    other cameras have an image. Each image goes to the instant nearest to it, each instant takes
    the nearest of a camera's images that is within half a period, and no image is used twice.
    """
    periods = [float(np.median(np.diff(t))) if len(t) > 1 else np.inf for t in times_s]
    middle = sorted(periods)[len(periods) // 2]
    reference = [p == middle or 0.99 < p / middle < 1.01 for p in periods].index(True)
    period, tolerance_s = periods[reference], periods[reference] / 2
    instants, real = _instants(times_s, reference, period)
    positions = np.stack([_nearest(t, instants, tolerance_s) for t in times_s], axis=1)
    count = (positions >= 0).sum(axis=1)
    keep = (real & (count > 0)) | (count >= 2)
    positions = positions[keep]
    return Pairing(positions, _mean_times(times_s, positions), reference, tolerance_s)


def seldom_paired(names: Sequence[str], counts: Sequence[int], pairing: Pairing) -> dict[str, str]:
    """A line for every camera with most pictures left over while most sets lack one.

    A fast camera leaves pictures over and a slow one lacks them; both at once mean another clock.
    """
    sets = len(pairing.times_s)
    used = (pairing.positions >= 0).sum(axis=0).tolist()
    return {
        name: f"camera {name}: {count - here} of {count} pictures belong to no frame set, and "
        f"{sets - here} of {sets} frame sets have none of it: do its stamps hold seconds, on the "
        "clock of the others?"
        for name, count, here in zip(names, counts, used, strict=True)
        if here < count / 2 and here < sets / 2
    }


def _instants(times_s: Sequence[Floats], reference: int, period: float) -> tuple[Floats, Bools]:
    """The reference's stamps and, where it has none, those next to other cameras' images."""
    own = times_s[reference]
    if not np.isfinite(period):
        return own, np.ones(len(own), bool)
    others = np.concatenate(list(times_s))
    before = own[0] - period * _neighbours((own[0] - others) / period)
    after = own[-1] + period * _neighbours((others - own[-1]) / period)
    between = []
    for i in np.flatnonzero(np.diff(own) > GAP_PERIODS * period):
        steps = round((own[i + 1] - own[i]) / period)
        step = (own[i + 1] - own[i]) / steps
        inside = others[(others > own[i]) & (others < own[i + 1])]
        missed = _neighbours((inside - own[i]) / step)
        between.append(own[i] + step * missed[missed < steps])
    virtual = np.concatenate([before, after, *between])
    instants = np.concatenate([own, virtual])
    real = np.arange(len(instants)) < len(own)
    order = np.argsort(instants, kind="stable")
    return instants[order], real[order]


def _neighbours(steps: Floats) -> Floats:
    """The whole numbers from 1 on next to these numbers, each once."""
    whole = np.unique(np.concatenate([np.floor(steps), np.ceil(steps)]))
    return whole[whole >= 1]


def _nearest(times: Floats, instants: Floats, tolerance_s: float) -> Ints:
    """For each instant the position of its image, or -1."""
    right = np.clip(np.searchsorted(instants, times), 1, max(len(instants) - 1, 1))
    right = np.minimum(right, len(instants) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(times - instants[left]) <= np.abs(times - instants[right])
    home = np.where(closer_left, left, right)
    distance = np.abs(times - instants[home])
    out = np.full(len(instants), -1, dtype=np.int64)
    # Written from the farthest to the nearest, so the nearest of several stays.
    for i in np.argsort(-distance, kind="stable"):
        if distance[i] <= tolerance_s * (1 + 1e-9):
            out[home[i]] = i
    return out


def _mean_times(times_s: Sequence[Floats], positions: Ints) -> Floats:
    pairs = zip(times_s, positions.T, strict=True)
    stacked = [np.where(at >= 0, times[at], np.nan) for times, at in pairs]
    return np.nanmean(stacked, axis=0) if len(positions) else np.zeros(0)


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
    scale_sd: float = UNSTATED_SCALE_SD  # of the world: see `Calibration`
    # numbers of the frame sets that are used, increasing; None: all.
    chosen: Ints | None = None

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

    def pair(self) -> Pairing:
        """Frames that form sets (see `pair_nearest`)."""
        whole = pair_nearest([stream.times_s for stream in self.streams.values()])
        if self.chosen is None:
            return whole
        positions, times_s = whole.positions[self.chosen], whole.times_s[self.chosen]
        return replace(whole, positions=positions, times_s=times_s)

    def clock_notes(self, known: Collection[str]) -> tuple[str, ...]:
        """Stamps with errors of their own, or that the pairing contradicts; a line each.

        Nothing of cameras that are `known` to have others.
        """
        counts = [len(stream) for stream in self.streams.values()]
        seldom = seldom_paired(list(self.streams), counts, self.pair())
        own = [(n, f"{n}: {note}") for n, s in self.streams.items() for note in s.stamps.notes]
        return tuple(text for name, text in (*own, *seldom.items()) if name not in known)

    def frame_sets(self, prefetch: int = DEFAULT_PREFETCH, start: int = 0) -> Iterator[FrameSet]:
        """Stream the frame sets (see `pair_nearest`) in order of time, decoded ahead.

        In bounded memory. SessionError: no two cameras have images close enough in time, or an
        image cannot be read (when its set is due).
        """
        paired = self.pair()
        if not np.any((paired.positions >= 0).sum(axis=1) >= 2):
            raise SessionError(
                f"{self.path}: no two cameras have images within {paired.tolerance_s:.4g} s of "
                "each other: check the clocks"
            )
        return stream_frame_sets(list(self.streams.values()), paired, prefetch, start)


def stream_frame_sets(
    streams: Sequence[Stream], pairing: Pairing, prefetch: int = DEFAULT_PREFETCH, start: int = 0
) -> Iterator[FrameSet]:
    """Yield frame sets in order; at most `prefetch` + 1 sets are held here at any time.

    Each camera has a thread that reads its frames one after the other, as suits a video best. A
    picture that cannot be read raises when its own frame set is due, not earlier. A JPEG that is
    cut off or damaged is left out, undecoded.
    """
    pools = {stream.name: ThreadPoolExecutor(1, "decode") for stream in streams}
    ahead: deque[tuple[int, dict[str, Future[Image | str]]]] = deque()
    due = iter(range(start, len(pairing.times_s)))
    try:
        while True:
            for index in islice(due, max(prefetch, 1) - len(ahead)):
                there = zip(streams, pairing.positions[index].tolist(), strict=True)
                read = {s.name: pools[s.name].submit(_read, s, p) for s, p in there if p >= 0}
                ahead.append((index, read))
            if not ahead:
                return
            index, futures = ahead.popleft()
            read_images = {name: future.result() for name, future in futures.items()}
            futures.clear()
            images = {n: image for n, image in read_images.items() if isinstance(image, Image)}
            damaged = {n: file for n, file in read_images.items() if isinstance(file, str)}
            yield FrameSet(index, float(pairing.times_s[index]), images, damaged)
            del read_images, images
    finally:
        for pool in pools.values():
            pool.shutdown(cancel_futures=True)


def _read(stream: Stream, position: int) -> Image | str:
    """The image, decoded; if its JPEG is damaged, the name of the file instead."""
    image = stream.read(position)
    if image.encoded is not None and is_torn(image.encoded):
        return stream.file_name(position)
    _ = image.pixels
    return image
