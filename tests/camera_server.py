"""Web cameras with manners of their own: the server of `measure play`, and what may go wrong."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

from measure_studio.capture.mjpeg import CameraHandler, part_head, serve_cameras


@dataclass
class ServedCamera:
    """One camera's pictures and its manners."""

    # JPEGs; from the last one on they come back in reverse, for ever. Others may be put in their
    # place at any time.
    pictures: Sequence[bytes]
    period_s: float = 1 / 30  # may be changed to a part of what it was
    phase_s: float = 0.0  # how much later than others it begins
    lengths: bool = True  # whether parts say how long they are
    stamps: bool = False  # whether parts carry the camera's own time
    late_s: Sequence[float] = (0.0,)  # how much later than taken each picture is sent, in turn
    breaks_after: int | None = None  # pictures, in the middle of one
    password: str | None = None  # asked for, with any user's name
    challenges: Sequence[str] = ()  # that ask for it; any answer to a digest challenge is taken
    answers: list[str] = field(default_factory=list)  # the `Authorization` headers that came
    # when each picture that was sent was taken, `time.time`, and which it was.
    taken_s: list[tuple[float, int]] = field(default_factory=list)

    def parts(self, begun: float) -> Iterator[bytes]:
        """Its parts from now on; all cameras began at the same time."""
        first = int((time.time() - begun) / self.period_s) + 1
        taken = begun + self.phase_s + (first - 1) * self.period_s
        for sent, turn in enumerate(range(first, 1 << 40)):
            taken += self.period_s
            late = self.late_s[turn % len(self.late_s)]
            time.sleep(max(taken + late - time.time(), 0.0))
            pictures = self.pictures
            order = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
            which = order[turn % len(order)]
            data = pictures[which]
            # A camera's clock starts from anything.
            stamp_s = taken - 1.6e9 if self.stamps else None
            head = part_head(len(data) if self.lengths else None, stamp_s)
            if sent == self.breaks_after:
                yield head + data[: len(data) // 2]
                return
            yield head + data + b"\r\n"
            self.taken_s.append((taken, which))


class _Handler(CameraHandler):
    """Answers with a still picture, too, and asks for passwords."""

    cameras: Mapping[str, ServedCamera]

    def answer(self, camera: str) -> None:
        if camera == "still":
            self.send_response(200)
            self.send_header("Content-Type", "image/jpeg")
            self.end_headers()
            self.wfile.write(next(iter(self.cameras.values())).pictures[0])
        elif camera in self.cameras and not self._is_allowed(self.cameras[camera]):
            self.send_response(401)
            for one in self.cameras[camera].challenges:
                self.send_header("WWW-Authenticate", one)
            self.end_headers()
        else:
            super().answer(camera)

    def _is_allowed(self, camera: ServedCamera) -> bool:
        token = self.headers.get("Authorization", "").removeprefix("Basic ")
        camera.answers.append(token)
        if token.startswith("Digest "):
            return True
        given = base64.b64decode(token).decode().partition(":")[2]
        return camera.password is None or given == camera.password


@contextmanager
def serving(cameras: Mapping[str, ServedCamera]) -> Iterator[dict[str, str]]:
    """Serve cameras; yields their addresses by name."""
    feeds = {name: partial(one.parts, time.time()) for name, one in cameras.items()}
    handler = type("Handler", (_Handler,), {"cameras": cameras})
    with serve_cameras(feeds, handler=handler) as addresses:
        yield {name: f"{address}?action=stream" for name, address in addresses.items()}
