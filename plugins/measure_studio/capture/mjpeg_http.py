"""Motion JPEG over HTTP, as web cameras and `mjpg-streamer` serve it: JPEGs, one after the other.

The stream is read here, not by a video library: those invent times, and decode what can be kept as
the camera made it. The format is that of RFC 2046 (multipart), as Netscape's server push used it.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from email.message import Message
from http.client import HTTPResponse
from io import BufferedIOBase

from measure.errors import CaptureError
from measure.limits import MOST_LETTERS
from measure.session.pictures import JPEG_END, is_complete_jpeg
from measure_studio.capture.http_stream import open_stream
from measure_studio.capture.sources import PATIENCE_S, Shot, Source
from measure_studio.capture.web_address import shown

_MAX_BYTES = 16 << 20  # Largest picture, with its headers: one of a hundred megapixels
_MAX_HEADERS = 64
_MAX_DIGITS = 20
_MAX_LINE = 8 << 10  # Bytes of a line that is not a picture's
_MAX_PICTURE_S = 3 * PATIENCE_S
"""Longest time for one picture: a camera may send bytes too slowly to count as silent."""
_MAX_RATE_HZ = 1000
_TIME_HEADERS = ("x-timestamp", "x-timestamp-sec")
"""Seconds on the camera's clock; the first is mjpg-streamer's."""


class HttpSource(Source):
    """A stream of JPEGs in a `multipart/x-mixed-replace` answer."""

    def __init__(self, address: str) -> None:
        super().__init__(shown(address))
        self._address = address

    def shots(self) -> Iterator[Shot]:
        """Pictures as they come; times of the camera's own clock where it sends them."""
        with open_stream(self._address) as (answer, stream):

            def begin_part() -> None:
                stream.allow("a picture", _MAX_PICTURE_S, _MAX_BYTES)

            body = _stream_of(answer, self.address)
            yield from _paced(parts_of(body, self.address, begin_part), self.address)


def _paced(shots: Iterator[Shot], address: str) -> Iterator[Shot]:
    """The same, as long as they are no flood that would leave no time for other cameras."""
    second, count = 0, 0
    for shot in shots:
        now = int(shot.arrived_s)
        second, count = now, 1 + count * (now == second)
        if count > _MAX_RATE_HZ:
            raise CaptureError(f"{address}: sends more than {_MAX_RATE_HZ} pictures a second")
        yield shot


def _stream_of(answer: HTTPResponse, address: str) -> BufferedIOBase:
    """The body of an answer that is a stream of parts."""
    if answer.headers.get("content-encoding", "identity").lower() != "identity":
        raise CaptureError(
            f"{address}: answers compressed, though that was not asked for: no camera does; give "
            "the address of the camera's MJPEG stream"
        )
    kind = answer.headers.get_content_type()
    if not kind.startswith("multipart/"):
        known = kind if len(kind) < MOST_LETTERS and kind.isprintable() else "something"
        raise CaptureError(
            f"{address}: answers {known}, not a stream of JPEGs (multipart/x-mixed-replace): give "
            "the address of the camera's MJPEG stream"
        )
    return answer


def parts_of(
    stream: BufferedIOBase, address: str, begin_part: Callable[[], None] = lambda: None
) -> Iterator[Shot]:
    """The pictures of a multipart stream, until it ends between two of them.

    Parts say how long they are, or end at the next boundary.

    Args:
        stream: from the answer's first byte on.
        begin_part: called where a part begins, or what comes before it: each has its own limits.

    Raises:
        CaptureError: it is no such stream, or breaks off inside a picture.
    """
    begin_part()
    boundary = _first_boundary(stream, address)
    while boundary is not None:
        headers = _headers(stream, address)
        length = headers.get("content-length", "")
        if length.isdecimal():
            data, line = _exactly(stream, length, address), b""
        else:
            data, line = _until(stream, boundary, address)
        # Before the next line is waited for: it may come with the next picture only.
        yield Shot(time.monotonic(), _stamp(headers), data)
        begin_part()
        boundary = _next_boundary(stream, boundary, line)


def _first_boundary(stream: BufferedIOBase, address: str) -> bytes | None:
    """The line before the first part; servers differ from what their header says of it."""
    for _ in range(_MAX_HEADERS):
        line = stream.readline(_MAX_LINE)
        if not line:
            return None
        if line.startswith(b"--"):
            return line.strip()
    raise CaptureError(f"{address}: no part of a stream of JPEGs begins in what it sends")


def _next_boundary(stream: BufferedIOBase, boundary: bytes, line: bytes) -> bytes | None:
    """The same line after a part, with `line` read already; None where the stream ends."""
    while line.strip() not in (boundary, boundary + b"--"):
        line = stream.readline(_MAX_LINE)
        if not line:
            return None
    return boundary if line.strip() == boundary else None


def _headers(stream: BufferedIOBase, address: str) -> Message:
    """What stands before a part's data."""
    out = Message()
    for _ in range(_MAX_HEADERS):
        line = stream.readline(_MAX_LINE)
        if not line.strip():
            return out
        name, _, value = line.decode("latin-1").partition(":")
        out[name.strip()] = value.strip()
    raise CaptureError(f"{address}: a part of the stream has no end of its headers")


def _exactly(stream: BufferedIOBase, length: str, address: str) -> bytes:
    if len(length) > _MAX_DIGITS or int(length) > _MAX_BYTES:
        raise CaptureError(f"{address}: announces a picture of {length[:20]} bytes")
    data = stream.read(int(length))
    if len(data) < int(length):
        raise CaptureError(f"{address}: the stream broke off inside a picture")
    return data


def _until(stream: BufferedIOBase, boundary: bytes, address: str) -> tuple[bytes, bytes]:
    """A part's data up to its JPEG's end or the next boundary; and that line, if it was read."""
    data = bytearray()
    for line in iter(lambda: stream.readline(_MAX_BYTES), b""):
        if line.strip() in (boundary, boundary + b"--"):
            return bytes(data).removesuffix(b"\n").removesuffix(b"\r"), line
        data += line
        end = line.rstrip(b"\r\n")
        if end.endswith(JPEG_END) and is_complete_jpeg(data):
            return bytes(data[: len(data) - len(line) + len(end)]), b""
        if len(data) > _MAX_BYTES:
            break
    raise CaptureError(f"{address}: the stream broke off inside a picture")


def _stamp(headers: Message) -> float | None:
    """A part's time on the camera's clock, if it states one."""
    for name in _TIME_HEADERS:
        with contextlib.suppress(ValueError):
            seconds = float(headers.get(name, ""))
            if math.isfinite(seconds):
                return seconds
    return None
