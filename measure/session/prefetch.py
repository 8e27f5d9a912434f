"""Frame sets decoded ahead in threads, in order, with a bound on what is in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from measure.model import FrameSet, Image
from measure.processes import usable_cores
from measure.session.pairing import Pairing
from measure.session.streams import Stream

DEFAULT_PREFETCH = 3
"""Frame sets decoded ahead of the one in use."""


def stream_frame_sets(
    streams: Sequence[Stream], pairing: Pairing, prefetch: int = DEFAULT_PREFETCH, start: int = 0
) -> Iterator[FrameSet]:
    """Yield frame sets in order; at most `prefetch` + 1 sets are held here at any time.

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
    pool = ThreadPoolExecutor(min(usable_cores(), 8), thread_name_prefix="decode")
    ahead: deque[tuple[int, dict[str, Future[Image]]]] = deque()
    last: dict[str, Future[Image]] = {}
    due = start
    try:
        while True:
            while due < len(pairing.times_s) and len(ahead) < prefetch:
                ahead.append((due, _submit(pool, streams, pairing, due, last)))
                due += 1
            if not ahead:
                return
            index, futures = ahead.popleft()
            images = {name: future.result() for name, future in futures.items()}
            futures.clear()
            yield FrameSet(index, float(pairing.times_s[index]), images)
            del images
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _members(
    streams: Sequence[Stream], pairing: Pairing, index: int
) -> Iterator[tuple[Stream, int]]:
    for stream, position in zip(streams, pairing.positions[index], strict=True):
        if position >= 0:
            yield stream, int(position)


def _submit(
    pool: ThreadPoolExecutor,
    streams: Sequence[Stream],
    pairing: Pairing,
    index: int,
    last: dict[str, Future[Image]],
) -> dict[str, Future[Image]]:
    futures = {}
    for stream, position in _members(streams, pairing, index):
        before = last.get(stream.name) if stream.serial else None
        futures[stream.name] = pool.submit(_read, stream, position, before)
        if stream.serial:
            last[stream.name] = futures[stream.name]
    return futures


def _read(stream: Stream, position: int, before: Future[Image] | None) -> Image:
    # A video is read in order. Waiting here cannot lock: the pool starts tasks in the order they
    # were given, so the one waited for is running or done.
    if before is not None:
        before.exception()
    image = stream.read(position)
    _ = image.pixels
    return image
