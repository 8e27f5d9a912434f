"""Motion JPEG over HTTP, as web cameras and `mjpg-streamer` serve it: JPEGs, one after the other.

The stream is read here, not by a video library: those invent times, and decode what can be kept as
the camera made it. The format is that of RFC 2046 (multipart), as Netscape's server push used it.
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import math
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from email.message import Message
from io import BufferedIOBase
from urllib.parse import unquote, urlsplit

from measure.capture.sources import PATIENCE_S, Shot, Source, without_user
from measure.errors import CaptureError
from measure.session.pictures import JPEG_END, is_complete_jpeg

_MAX_BYTES = 64 << 20
"""Largest picture, and longest line."""
_MAX_HEADERS = 64
_MAX_PICTURE_S = 3 * PATIENCE_S
"""Longest time for one picture: a camera may send bytes too slowly to count as silent."""
_TIME_HEADERS = ("x-timestamp", "x-timestamp-sec")
"""Seconds on the camera's clock; the first is mjpg-streamer's."""


class HttpSource(Source):
    """A stream of JPEGs in a `multipart/x-mixed-replace` answer."""

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self._request = urllib.request.Request(without_user(address))
        if parts.username is not None:
            pair = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            token = base64.b64encode(pair.encode()).decode()
            self._request.add_header("Authorization", f"Basic {token}")
        super().__init__(without_user(address))

    def shots(self) -> Iterator[Shot]:
        """Pictures as they come; times of the camera's own clock where it sends them."""
        try:
            with urllib.request.urlopen(self._request, timeout=PATIENCE_S) as answer:
                yield from parts_of(_stream_of(answer, self.address), self.address)
        except urllib.error.HTTPError as problem:
            problem.close()
            raise CaptureError(f"{self.address}: answers {problem.code} {problem.reason}") from None
        except (OSError, http.client.HTTPException, ValueError) as problem:
            reason = getattr(problem, "reason", None) or problem
            text = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
            raise CaptureError(f"{self.address}: {text}") from None


def _stream_of(answer: http.client.HTTPResponse, address: str) -> BufferedIOBase:
    """The body of an answer that is a stream of parts.

    Raises:
        CaptureError: it is something else.
    """
    kind = answer.headers.get_content_type()
    if not kind.startswith("multipart/"):
        raise CaptureError(
            f"{address}: answers {kind}, not a stream of JPEGs (multipart/x-mixed-replace): give "
            "the address of the camera's MJPEG stream"
        )
    return answer


def parts_of(stream: BufferedIOBase, address: str) -> Iterator[Shot]:
    """The pictures of a multipart stream, until it ends between two of them.

    Parts say how long they are, or end at the next boundary.

    Args:
        stream: from the answer's first byte on.
        address: for messages.

    Raises:
        CaptureError: it is no such stream, or breaks off inside a picture.
    """
    boundary = _first_boundary(stream, address)
    while boundary is not None:
        headers = _headers(stream, address)
        length = headers.get("content-length", "")
        if length.isdecimal():
            data, line = _exactly(stream, int(length), address), b""
        else:
            data, line = _until(stream, boundary, address)
        # Before the next line is waited for: it may come with the next picture only.
        yield Shot(time.monotonic(), _stamp(headers), data)
        boundary = _next_boundary(stream, boundary, line)


def _first_boundary(stream: BufferedIOBase, address: str) -> bytes | None:
    """The line before the first part; servers differ from what their header says of it."""
    for _ in range(_MAX_HEADERS):
        line = stream.readline(_MAX_BYTES)
        if not line:
            return None
        if line.startswith(b"--"):
            return line.strip()
    raise CaptureError(f"{address}: no part of a stream of JPEGs begins in what it sends")


def _next_boundary(stream: BufferedIOBase, boundary: bytes, line: bytes) -> bytes | None:
    """The same line after a part, of which `line` has been read; None where the stream ends."""
    while line.strip() not in (boundary, boundary + b"--"):
        line = stream.readline(_MAX_BYTES)
        if not line:
            return None
    return boundary if line.strip() == boundary else None


def _headers(stream: BufferedIOBase, address: str) -> Message:
    """What stands before a part's data."""
    out = Message()
    for _ in range(_MAX_HEADERS):
        line = stream.readline(_MAX_BYTES)
        if not line.strip():
            return out
        name, _, value = line.decode("latin-1").partition(":")
        out[name.strip()] = value.strip()
    raise CaptureError(f"{address}: a part of the stream has no end of its headers")


def _exactly(stream: BufferedIOBase, length: int, address: str) -> bytes:
    if length > _MAX_BYTES:
        raise CaptureError(f"{address}: announces a picture of {length} bytes")
    data, until_s = bytearray(), time.monotonic() + _MAX_PICTURE_S
    while len(data) < length:
        some = stream.read1(length - len(data))
        if not some:
            raise CaptureError(f"{address}: the stream broke off inside a picture")
        data += some
        if time.monotonic() > until_s:
            raise CaptureError(
                f"{address}: a picture did not come to its end in {_MAX_PICTURE_S:g} s"
            )
    return bytes(data)


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
