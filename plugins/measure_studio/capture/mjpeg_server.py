"""The other end of `mjpeg_http`: pictures served on loopback as web cameras serve theirs.

A camera is a feed: a function that begins to give the parts of a `multipart/x-mixed-replace`
answer, each when its turn has come. Every reader gets one of its own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TypeAlias
from urllib.parse import quote, unquote, urlsplit

from measure.errors import ConfigError

Feed: TypeAlias = Callable[[], Iterator[bytes]]
_HOST, _BOUNDARY = "127.0.0.1", "picture"


def part_head(size: int | None, stamp_s: float | None) -> bytes:
    """What stands before a picture.

    Args:
        size: of the picture in bytes, if it is given.
        stamp_s: when it was taken, on the camera's clock, if it has one.
    """
    lines = [f"--{_BOUNDARY}", "Content-Type: image/jpeg"]
    lines += [] if size is None else [f"Content-Length: {size}"]
    lines += [] if stamp_s is None else [f"X-Timestamp: {stamp_s:.9f}"]
    return "\r\n".join([*lines, "", ""]).encode()


def picture_part(jpeg: bytes, stamp_s: float | None = None) -> bytes:
    """A part with a picture, whole."""
    return part_head(len(jpeg), stamp_s) + jpeg + b"\r\n"


class CameraHandler(BaseHTTPRequestHandler):
    """Answers one request for a camera."""

    protocol_version = "HTTP/1.0"
    feeds: Mapping[str, Feed]

    def do_GET(self) -> None:
        """Answer a request; the path is the camera's name."""
        self.answer(unquote(urlsplit(self.path).path.strip("/")))

    def answer(self, camera: str) -> None:
        """Send a camera's parts until there are no more or the reader goes; 404 if none is it."""
        if camera not in self.feeds:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.end_headers()
        with suppress(OSError):  # whoever looked may go
            for data in self.feeds[camera]():
                self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Nobody reads it."""


@contextmanager
def serve_cameras(
    feeds: Mapping[str, Feed], port: int = 0, handler: type[CameraHandler] = CameraHandler
) -> Iterator[dict[str, str]]:
    """Serve cameras to this machine; yields their addresses by name.

    Args:
        feeds: by camera.
        port: to listen on; 0 for any that is free.

    Raises:
        ConfigError: nothing can listen there.
    """
    try:
        server = ThreadingHTTPServer((_HOST, port), type("Handler", (handler,), {"feeds": feeds}))
    except (OSError, OverflowError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        text = f"{_HOST}, port {port}: nothing can listen there ({reason}); 0 takes a free one"
        raise ConfigError(text) from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    place = f"http://{_HOST}:{server.server_address[1]}"
    try:
        yield {name: f"{place}/{quote(name, safe='')}" for name in feeds}
    finally:
        server.shutdown()
        server.server_close()
