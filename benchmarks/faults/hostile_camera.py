"""A camera on loopback that delivers motion JPEG over HTTP, and has whatever fault it is told."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field

LOGIN, TOKEN = "watcher:s3cret", "t0ken"
"""What must never be seen again: a user with a password, and a query."""


OK = b"HTTP/1.0 200 OK\r\n"


class GoneError(Exception):
    """The connection is over."""


@dataclass
class Wire:
    """One connection to a camera."""

    socket: socket.socket
    is_wanted: Callable[[], bool]
    """Whether the fault that it shows is still the camera's."""
    sent: int = 0
    """Bytes."""

    def send(self, *data: bytes) -> None:
        """Send it at once."""
        try:
            self.socket.sendall(b"".join(data))
        except OSError:
            raise GoneError from None
        self.sent += sum(map(len, data))

    def repeat(self, data: bytes, every_s: float) -> None:
        """Send the same again and again, as long as it is wanted."""
        while self.is_wanted():
            self.send(data)
            time.sleep(every_s)

    def drip(self, data: bytes, every_s: float = 0.3) -> None:
        """Send it byte by byte."""
        for k in range(len(data)):
            if not self.is_wanted():
                return
            self.send(data[k : k + 1])
            time.sleep(every_s)

    def hang(self) -> None:
        """Say nothing, as long as it is wanted."""
        while self.is_wanted():
            time.sleep(0.05)


@dataclass
class Turn:
    """A picture that is due."""

    number: int
    taken_s: float
    jpeg: bytes
    camera: HostileCamera

    def part(self, jpeg: bytes | None = None, /, **more: object) -> bytes:
        """A part of the stream, like a good camera's but for what is said otherwise."""
        data = self.jpeg if jpeg is None else jpeg
        lines = {
            "boundary": "picture",
            "Content-Type": "image/jpeg",
            "Content-Length": len(data),
            "X-Timestamp": f"{self.taken_s - 1.6e9:.6f}",
        } | more
        boundary = lines.pop("boundary")
        head = [f"--{boundary}", *(f"{k}: {v}" for k, v in lines.items() if v is not None), "", ""]
        return "\r\n".join(head).encode() + data + b"\r\n"


@dataclass(frozen=True)
class Fault:
    """What may be wrong with a camera.

    Attributes:
        name: in words.
        silences: whether no new picture can be had while it lasts; None where some may.
        answer: what it does instead of answering a request.
        part: what it does instead of sending a picture.
    """

    name: str
    silences: bool | None
    answer: Callable[[Wire, HostileCamera], None] | None = None
    part: Callable[[Wire, Turn], None] | None = None


@dataclass
class HostileCamera:
    """One camera.

    Attributes:
        pictures: JPEGs; from the last one on they come back in reverse, for ever.
        strange: pictures of another camera.
        period_s: between two of them.
        begun_s: when the first was due, `time.time`.
        fault: what is wrong with it now.
        good_s: when the last picture that a reader can use was sent.
        sent: bytes that a reader took on one connection, at most, what is under way included.
        leaked: what it heard at an address that it redirected to, and should not have.
    """

    pictures: Sequence[bytes]
    strange: Sequence[bytes] = ()
    period_s: float = 1 / 15
    begun_s: float = field(default_factory=time.time)
    fault: Fault | None = None
    good_s: float = float("nan")
    sent: int = 0
    leaked: list[str] = field(default_factory=list)
    port: int = 0
    elsewhere: int = 0

    @property
    def address(self) -> str:
        """Where it is, password and all."""
        return f"http://{LOGIN}@127.0.0.1:{self.port}/stream?token={TOKEN}"

    def order(self) -> list[int]:
        """Which pictures follow each other."""
        return [*range(len(self.pictures)), *range(len(self.pictures) - 2, 0, -1)]

    def connect(self, wire: Wire, request: bytes) -> None:
        """Answer a request."""
        fault, elsewhere = self.fault, b"/elsewhere" in request
        wire.is_wanted = lambda: self.fault is fault
        if elsewhere:
            self.leaked += [text for text in ("uthorization", TOKEN) if text.encode() in request]
        elif fault is not None and fault.answer is not None:
            fault.answer(wire, self)
            return
        wire.send(OK, b"Content-Type: multipart/x-mixed-replace; boundary=picture\r\n\r\n")
        for turn in self.turns():
            elsewhere &= self.fault in (fault, None)  # then it is a camera like others
            fault = fault if elsewhere else self.fault
            if not elsewhere and fault is not None and fault.answer is not None:
                return
            if fault is None or fault.part is None:
                wire.send(turn.part())
                self.good_s = time.time()
            else:
                wire.is_wanted = lambda shown=fault: self.fault is shown  # type: ignore[misc]
                fault.part(wire, turn)

    def turns(self) -> Iterator[Turn]:
        """Pictures as they become due."""
        order = self.order()
        first = int((time.time() - self.begun_s) / self.period_s) + 1
        for number in range(first, 1 << 40):
            taken_s = self.begun_s + number * self.period_s
            time.sleep(max(taken_s - time.time(), 0.0))
            jpeg = self.pictures[order[number % len(order)]]
            yield Turn(number, taken_s, _numbered(jpeg, number), self)


def _numbered(jpeg: bytes, number: int) -> bytes:
    """The picture with a comment: no two of a real camera are equal, whichever are lost."""
    return b"".join((jpeg[:2], b"\xff\xfe\x00\x06", number.to_bytes(4, "big"), jpeg[2:]))


def _listen(camera: HostileCamera, server: socket.socket) -> None:
    while True:
        try:
            connection, _ = server.accept()
        except OSError:
            return
        threading.Thread(target=_talk, args=(camera, connection), daemon=True).start()


def _talk(camera: HostileCamera, connection: socket.socket) -> None:
    with closing(connection), suppress(OSError, GoneError):
        connection.settimeout(10.0)
        request = b""
        while b"\r\n\r\n" not in request:
            request += connection.recv(4096) or b"\r\n\r\n"
        wire = Wire(connection, lambda: True)
        try:
            camera.connect(wire, request)
        finally:
            camera.sent = max(camera.sent, wire.sent)


@contextmanager
def hostile(cameras: Sequence[HostileCamera]) -> Iterator[list[str]]:
    """Let cameras be there; yields their addresses, password and all."""
    servers = []
    for camera in cameras:
        pair = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        camera.port, camera.elsewhere = (one.getsockname()[1] for one in pair)
        for server in pair:
            threading.Thread(target=_listen, args=(camera, server), daemon=True).start()
        servers += pair
    try:
        yield [camera.address for camera in cameras]
    finally:
        for server in servers:
            server.shutdown(socket.SHUT_RDWR)
            server.close()
