"""Web cameras on loopback: a session's pictures as real motion-JPEG streams over HTTP."""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

BOUNDARY = "picture"


@dataclass
class ServedCamera:
    """One camera's pictures and its manners.

    Attributes:
        pictures: JPEGs; from the last one on they come back in reverse, for ever. Others may be put
            in their place at any time.
        period_s: between two of them; it may be changed to a part of what it was.
        phase_s: how much later than others it begins.
        lengths: whether parts say how long they are.
        stamps: whether parts carry the camera's own time.
        late_s: how much later than taken each picture is sent, in turn.
        breaks_after: pictures after which the connection breaks off in the middle of one.
        password: asked for, with any user's name.
        taken_s: when each picture that was sent was taken, `time.time`, and which it was.
    """

    pictures: Sequence[bytes]
    period_s: float = 1 / 30
    phase_s: float = 0.0
    lengths: bool = True
    stamps: bool = False
    late_s: Sequence[float] = (0.0,)
    breaks_after: int | None = None
    password: str | None = None
    taken_s: list[tuple[float, int]] = field(default_factory=list)


class _Handler(BaseHTTPRequestHandler):
    """Answers a request; `serving` tells its class of the cameras, and when they began."""

    protocol_version = "HTTP/1.0"
    cameras: Mapping[str, ServedCamera]
    begun: float

    def do_GET(self) -> None:
        path = urlsplit(self.path).path.strip("/")
        if path == "still":
            self._answer("image/jpeg")
            self.wfile.write(next(iter(self.cameras.values())).pictures[0])
        elif path not in self.cameras:
            self.send_error(404)
        elif not self._is_allowed(self.cameras[path]):
            self.send_error(401)
        else:
            self._stream(self.cameras[path])

    def _answer(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.end_headers()

    def _is_allowed(self, camera: ServedCamera) -> bool:
        token = self.headers.get("Authorization", "").removeprefix("Basic ")
        given = base64.b64decode(token).decode().partition(":")[2]
        return camera.password is None or given == camera.password

    def _stream(self, camera: ServedCamera) -> None:
        self._answer(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        with suppress(OSError):  # whoever looked may go
            self._parts(camera)

    def _parts(self, camera: ServedCamera) -> None:
        first = int((time.time() - self.begun) / camera.period_s) + 1
        taken = self.begun + camera.phase_s + (first - 1) * camera.period_s
        for sent, turn in enumerate(range(first, 1 << 40)):
            taken += camera.period_s
            late = camera.late_s[turn % len(camera.late_s)]
            time.sleep(max(taken + late - time.time(), 0.0))
            pictures = camera.pictures
            order = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
            which = order[turn % len(order)]
            data = pictures[which]
            if sent == camera.breaks_after:
                self.wfile.write(_head(camera, data, taken) + data[: len(data) // 2])
                return
            self.wfile.write(_head(camera, data, taken) + data + b"\r\n")
            camera.taken_s.append((taken, which))

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving(cameras: Mapping[str, ServedCamera]) -> Iterator[dict[str, str]]:
    """Serve cameras; yields their addresses by name."""
    told = {"cameras": cameras, "begun": time.time()}
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), told))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    host, port = server.server_address[:2]
    try:
        yield {name: f"http://{host!s}:{port}/{name}?action=stream" for name in cameras}
    finally:
        server.shutdown()
        server.server_close()


def _head(camera: ServedCamera, data: bytes, taken: float) -> bytes:
    lines = [f"--{BOUNDARY}", "Content-Type: image/jpeg"]
    lines += [f"Content-Length: {len(data)}"] * camera.lengths
    # A camera's clock starts from anything.
    lines += [f"X-Timestamp: {taken - 1.6e9:.6f}"] * camera.stamps
    return "\r\n".join([*lines, "", ""]).encode()
