"""JPEG pictures that are damaged, which decoders fill with grey or shifted blocks."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

from measure.session.pictures import JPEG_END, JPEG_SCAN, is_complete_jpeg
from measure.session.streams import Stream

_STRAY_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xdc\xff]", re.DOTALL)
"""Within a scan only a restart or the number of lines may stand (ITU-T T.81, B.1.1)."""


def is_damaged(jpeg: bytes) -> bool:
    """Whether a JPEG is cut off, or a part of its scan is missing or overwritten.

    Some wrong bytes pass, because the entropy code resynchronises. What FFmpeg cannot decode at all
    is not judged.
    """
    scan = jpeg.rfind(JPEG_SCAN)
    end = jpeg.find(JPEG_END, scan)
    if not is_complete_jpeg(jpeg) or _STRAY_MARKER.search(jpeg, scan + 2, end):
        return True
    return not _decodes(jpeg, {"err_detect": "explode"}) and _decodes(jpeg, {})


def damaged_frames(streams: Sequence[Stream], step: Callable[[], None]) -> dict[str, list[int]]:
    """Numbers of the damaged frames of each stream of JPEG pictures.

    Args:
        streams: those of a session that hold JPEGs.
        step: called after every position in the streams.

    Raises:
        SessionError: a picture cannot be read.
    """
    found: dict[str, list[int]] = {stream.name: [] for stream in streams}
    with ThreadPoolExecutor(max(len(streams), 1)) as pool:
        for index in range(max(map(len, streams), default=0)):
            here = [stream for stream in streams if index < len(stream)]
            for stream, bad in zip(here, pool.map(_damaged_at, here, repeat(index)), strict=False):
                if bad:
                    found[stream.name].append(int(stream.frames[index]))
            step()
    return found


def holds_jpeg(stream: Stream) -> bool:
    """Whether a stream's pictures are JPEGs, by its first."""
    return stream.read(0).encoded is not None


def _damaged_at(stream: Stream, index: int) -> bool:
    jpeg = stream.read(index).encoded
    return jpeg is not None and is_damaged(jpeg)


def _decodes(jpeg: bytes, options: dict[str, str]) -> bool:
    import av

    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = options
    try:
        return bool(decoder.decode(av.Packet(jpeg)) + decoder.decode(None))
    except av.error.FFmpegError:
        return False
