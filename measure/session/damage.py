"""Damaged JPEGs, which decoders fill with grey or shifted blocks, and videos that are cut short."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from measure.errors import SessionError
from measure.session.pictures import JPEG_END, JPEG_SCAN, jpeg_segments

if TYPE_CHECKING:
    from measure.session.streams import Stream

_HOLE = bytes(64)  # To which blank parts of a picture may be coded, too


def is_torn(jpeg: bytes) -> bool:
    """What of `is_damaged` shows without decoding, mostly: no end, a stray marker, a hole."""
    segments = [*jpeg_segments(jpeg)]
    if not segments or segments[-1][0] != JPEG_END[1]:
        return True
    scan = next((at for kind, at in segments if kind == JPEG_SCAN[1]), 0)
    return jpeg.find(_HOLE, scan, segments[-1][1]) >= 0 and _is_undecodable(jpeg)


def is_damaged(jpeg: bytes) -> bool:
    """Whether a JPEG is cut off, or a part of its scan is missing or overwritten.

    Some wrong bytes pass, because the entropy code resynchronises. What FFmpeg cannot decode at all
    is not judged.
    """
    return is_torn(jpeg) or _is_undecodable(jpeg)


def _is_undecodable(jpeg: bytes) -> bool:
    return not _decodes(jpeg, {"err_detect": "explode"}) and _decodes(jpeg, {})


def damaged_frames(streams: Sequence[Stream], step: Callable[[], None]) -> dict[str, list[int]]:
    """Numbers of the damaged frames of streams of JPEGs; `step` is called after every position."""
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
    decoder.options = {**options, "lowres": "3"}  # All of the scan is read, an eighth of it drawn
    decoder.thread_count = 1
    try:
        return bool(decoder.decode(av.Packet(jpeg)) + decoder.decode(None))
    except av.error.FFmpegError:
        return False


_REMEDY = "; to use the rest, copy it (ffmpeg -i OLD -c copy NEW) and keep as many timestamps"
_AVI_LISTS = (b"AVI ", b"AVIX", b"movi", b"rec ")
"""AVI lists whose chunks are counted; all others are skipped."""
_AVI_PICTURES = (b"dc", b"db")
_EBML_HEADER, _MATROSKA_SEGMENT = 0x1A45DFA3, 0x18538067


def refuse_truncated(
    container: Any, stream: Any, packets: list[Any], counted: bool, path: Path, where: str
) -> None:
    """Refuse (SessionError) a video that ends before the end its container (PyAV's) states."""
    promised, there = int(stream.frames or 0), len(packets)
    if counted and promised > there:
        there = _count_chunks(path, stream.index)
    lacks = ""
    if promised > there > 0:
        lacks = f"{there} of {promised} frames are there"
    elif not promised and (missing := _missing_s(container, stream, packets)):
        lacks = f"its last {missing:.2f} s are missing"
    # Frames are stored in the order in which they decode: the last ones need not be the latest.
    elif "matroska" in container.format.name and (short := _missing_bytes(path)):
        lacks = f"its last {short} bytes are missing"
    if lacks:
        raise SessionError(f"{where}{path}: the video is cut off: {lacks}{_REMEDY}")


def _missing_s(container: Any, stream: Any, packets: list[Any]) -> float:
    """Seconds missing of the duration, for containers that state no number of frames."""
    stamps = [packet[0] for packet in packets if packet[0] is not None]
    # With sound the duration may be the sound's.
    if not container.duration or not stamps or len(container.streams) > 1:
        return 0.0
    start, end = (float(stamp * stream.time_base) for stamp in (min(stamps), max(stamps)))
    step = (end - start) / (len(stamps) - 1) if len(stamps) > 1 else 0.1
    missing = container.duration / 1e6 - end - step
    return missing if missing > 0.75 * step + 0.002 else 0.0


def _count_chunks(path: Path, stream: int) -> int:
    """Number of whole chunks of an AVI video stream, the empty ones of dropped frames included.

    Source: Microsoft, "AVI RIFF File Reference", and OpenDML AVI 1.02 for files of several RIFFs.
    """
    own = b"%02d" % stream
    end, count = path.stat().st_size, 0
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            kind, size = head[:4], int.from_bytes(head[4:], "little")
            if kind in (b"RIFF", b"LIST"):
                name = file.read(4)
                if name in _AVI_LISTS:
                    continue
                size -= 4
            begin = file.tell()
            if kind[:2] == own and kind[2:] in _AVI_PICTURES and begin + size <= end:
                count += 1
            file.seek(max(size, 0) + size % 2, 1)
    return count


def _missing_bytes(path: Path) -> int:
    """How many bytes a Matroska file is shorter than its segment states.

    0 too where it states no size: a recorder that was stopped by force, or writes to a pipe, leaves
    it open.

    Source: RFC 8794 (EBML), sections 4 to 6; RFC 9559 (Matroska), section 5.
    """
    with path.open("rb") as file:
        if _number(file, marked=True) != _EBML_HEADER or (size := _number(file)) is None:
            return 0
        file.seek(size, 1)
        if _number(file, marked=True) != _MATROSKA_SEGMENT or (size := _number(file)) is None:
            return 0
        return max(file.tell() + size - path.stat().st_size, 0)


def _number(file: BinaryIO, marked: bool = False) -> int | None:
    """A variable-size integer, with its marker bit if it names an element; None if unknown."""
    first = file.read(1)
    length = 9 - first[0].bit_length() if first and first[0] else 0
    rest = file.read(max(length - 1, 0))
    if not length or len(rest) < length - 1:
        return None
    value = int.from_bytes(first + rest, "big")
    if marked:
        return value
    value &= (1 << 7 * length) - 1
    return None if value == (1 << 7 * length) - 1 else value
