"""What may be wrong with a camera, and what a reader of its pictures is told.

`python -m benchmarks.faults cameras --count N` meets N cameras, each with a fault drawn at random,
and says what is told of it, and after how long.
"""

from __future__ import annotations

import math
import random
import re
import socket
import struct
import time
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.faults.hostile_camera import (
    LOGIN,
    OK,
    TOKEN,
    Fault,
    GoneError,
    HostileCamera,
    Turn,
    Wire,
    hostile,
)
from measure.errors import CaptureError, SessionError
from measure_studio.capture import CameraAddress
from measure_studio.capture.sources import Shot, image_of, is_whole, size_wh


def _redirects(to: str) -> Callable[[Wire, HostileCamera], None]:
    def answer(wire: Wire, camera: HostileCamera) -> None:
        place = to.format(port=camera.port, elsewhere=camera.elsewhere)
        wire.send(f"HTTP/1.0 302 Found\r\nLocation: {place}\r\n\r\n".encode())

    return answer


def _says(data: bytes) -> Callable[[Wire, HostileCamera], None]:
    return lambda wire, camera: wire.send(data)


def _huge_head(wire: Wire, camera: HostileCamera) -> None:
    """The first of it alone, so that what is read ahead ends between two reads of 8 KiB."""
    wire.send(OK, b"X-Long: ")
    time.sleep(0.02)
    wire.repeat(b"x" * 65_536, 0.001)


def _bomb(coding: str) -> Callable[[Wire, HostileCamera], None]:
    """An answer of zeros that are 4 GB once they are unpacked: a thousandth of that on the wire."""

    def answer(wire: Wire, camera: HostileCamera) -> None:
        kind = b"Content-Type: multipart/x-mixed-replace; boundary=picture\r\n"
        wire.send(OK, kind, f"Content-Encoding: {coding}\r\n\r\n".encode())
        packer = zlib.compressobj(9, wbits=31 if coding == "gzip" else 15)
        block = bytes(1 << 20)
        for _ in range(4096):
            if not wire.is_wanted():
                return
            if packed := packer.compress(block):
                wire.send(packed)
        wire.send(packer.flush())
        wire.hang()

    return answer


def _reset(wire: Wire, turn: Turn) -> None:
    wire.send(turn.part()[: len(turn.jpeg) // 2])
    wire.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    raise GoneError


def _half_closed(wire: Wire, turn: Turn) -> None:
    wire.send(turn.part()[: len(turn.jpeg) // 2])
    with suppress(OSError):
        wire.socket.shutdown(socket.SHUT_WR)
    wire.hang()
    raise GoneError


def _endless_part(wire: Wire, turn: Turn) -> None:
    wire.send(turn.part(**{"Content-Length": None})[:-100])
    wire.repeat(b"x" * 65_536, 0.002)
    raise GoneError


def _endless_headers(wire: Wire, turn: Turn) -> None:
    wire.send(b"--picture\r\n")
    wire.repeat(b"X-More: " + b"x" * 1000 + b"\r\n", 0.002)
    raise GoneError


def _burst(wire: Wire, turn: Turn) -> None:
    if turn.number % 15:
        return
    order = turn.camera.order()
    for number in range(turn.number - 14, turn.number + 1):
        taken_s = turn.camera.begun_s + number * turn.camera.period_s
        jpeg = turn.camera.pictures[order[number % len(order)]]
        wire.send(Turn(number, taken_s, jpeg, turn.camera).part())


def _flood(wire: Wire, turn: Turn) -> None:
    while wire.is_wanted():
        wire.send(b"--picture\r\nContent-Length: 4\r\n\r\n\xff\xd8\xff\xd9\r\n" * 50)
    raise GoneError


def _sends(change: Callable[[Turn], bytes]) -> Callable[[Wire, Turn], None]:
    return lambda wire, turn: wire.send(change(turn))


def _drips(wire: Wire, turn: Turn) -> None:
    wire.drip(turn.part(), 0.02)


def sized(jpeg: bytes, size_wh: tuple[int, int]) -> bytes:
    """The same picture, which says that it has another size."""
    at = next(k for k in range(len(jpeg)) if jpeg[k] == 0xFF and jpeg[k + 1] in (0xC0, 0xC2))
    return jpeg[: at + 5] + struct.pack(">HH", size_wh[1], size_wh[0]) + jpeg[at + 9 :]


def _garbled(turn: Turn) -> bytes:
    draw = random.Random(turn.number)
    middle = len(turn.jpeg) // 2
    return turn.part(turn.jpeg[:middle] + draw.randbytes(2000) + turn.jpeg[middle + 2000 :])


def _undecodable(turn: Turn) -> bytes:
    """Without the tables that its coefficients were divided by."""
    return turn.part(turn.jpeg.replace(b"\xff\xdb", b"\xff\xeb"))


def _dark(turn: Turn) -> bytes:
    noise = np.random.default_rng(turn.number).integers(0, 12, _shape(turn.jpeg), dtype=np.uint8)
    return turn.part(cv2.imencode(".jpg", noise)[1].tobytes())


def _shape(jpeg: bytes) -> tuple[int, ...]:
    at = next(k for k in range(len(jpeg)) if jpeg[k] == 0xFF and jpeg[k + 1] in (0xC0, 0xC2))
    return (*struct.unpack(">HH", jpeg[at + 5 : at + 9]), 3)


def _before(turn: Turn) -> bytes:
    order = turn.camera.order()
    return turn.part(turn.camera.pictures[order[(turn.number - 9) % len(order)]])


def _strange(turn: Turn) -> bytes:
    """What the other camera shows at that time."""
    pictures, order = turn.camera.strange, turn.camera.order()
    return turn.part(pictures[order[turn.number % len(order)]] if pictures else turn.jpeg)


def _stamped(change: Callable[[float], float | None]) -> Callable[[Turn], bytes]:
    return lambda turn: turn.part(**{"X-Timestamp": change(turn.taken_s)})


def _jumping(turn: Turn) -> bytes:
    """By a second, with every seventh picture."""
    return turn.part(**{"X-Timestamp": turn.taken_s - 1.0 * (turn.number // 7)})


FAULTS = (
    Fault("head byte by byte", True, lambda wire, _: wire.drip(OK + b"X-Long: " + b"x" * 4000)),
    Fault(
        "head without end", True, lambda wire, _: wire.repeat(b"HTTP/1.0 100 More\r\n\r\n", 0.01)
    ),
    Fault("header of gigabytes", True, _huge_head),
    Fault("a bomb of 4 GB, gzip", True, _bomb("gzip")),
    Fault("a bomb of 4 GB, deflate", True, _bomb("deflate")),
    Fault("redirects to itself", True, _redirects("http://127.0.0.1:{port}/again")),
    Fault("redirects to a file", True, _redirects("file:///etc/passwd")),
    Fault("redirects to another host", None, _redirects("http://127.0.0.1:{elsewhere}/elsewhere")),
    Fault("404", True, _says(b"HTTP/1.0 404 Gone\r\n\r\n")),
    Fault("503", True, _says(b"HTTP/1.0 503 \x1b[31mBusy\r\n\r\n")),
    Fault("a page", True, _says(OK + b"Content-Type: text/html\r\n\r\n<html>")),
    Fault("no HTTP", True, _says(b"\x00\x01\x02 what?\r\n\r\n" * 100)),
    Fault("no answer", True, lambda wire, _: wire.hang()),
    Fault("closes at once", True, lambda wire, _: None),
    Fault("stall", True, part=lambda wire, turn: None),
    Fault("reset in a picture", True, part=_reset),
    Fault("half-closed in a picture", True, part=_half_closed),
    Fault("wrong boundary", True, part=_sends(lambda turn: turn.part(boundary=f"x{turn.number}"))),
    Fault("no length", False, part=_sends(lambda turn: turn.part(**{"Content-Length": None}))),
    Fault("part without end", True, part=_endless_part),
    Fault("headers of a part without end", True, part=_endless_headers),
    Fault("huge length", True, part=_sends(lambda turn: turn.part(**{"Content-Length": 10**11}))),
    Fault(
        "length of 5000 digits",
        True,
        part=_sends(lambda t: t.part(**{"Content-Length": "9" * 5000})),
    ),
    Fault(
        "length too large",
        None,
        part=_sends(lambda turn: turn.part(**{"Content-Length": len(turn.jpeg) + 3000})),
    ),
    Fault("picture byte by byte", True, part=_drips),
    Fault("torn picture", True, part=_sends(lambda turn: turn.part(turn.jpeg[:-4000]))),
    Fault(
        "no picture", True, part=_sends(lambda turn: turn.part(random.Random(1).randbytes(9999)))
    ),
    Fault("garbled picture", False, part=_sends(_garbled)),
    Fault("picture that cannot be decoded", True, part=_sends(_undecodable)),
    Fault("other size", True, part=_sends(lambda turn: turn.part(sized(turn.jpeg, (320, 240))))),
    Fault(
        "huge size", True, part=_sends(lambda turn: turn.part(sized(turn.jpeg, (65_500, 65_500))))
    ),
    Fault("frozen", True, part=_sends(lambda turn: turn.part(turn.camera.pictures[0]))),
    Fault("pictures of before", False, part=_sends(_before)),
    Fault("dark", False, part=_sends(_dark)),
    Fault("pictures of another camera", None, part=_sends(_strange)),
    Fault("no stamps", False, part=_sends(_stamped(lambda taken_s: None))),
    Fault("stamps backwards", False, part=_sends(_stamped(lambda taken_s: 1e9 - taken_s))),
    Fault("stamps that are no numbers", False, part=_sends(_stamped(lambda taken_s: math.nan))),
    Fault("stamps that jump back", False, part=_sends(_jumping)),
    Fault("stamps an hour ahead", False, part=_sends(_stamped(lambda taken_s: taken_s + 3600))),
    Fault("bursts", None, part=_burst),
    Fault("flood of nothing", True, part=_flood),
)


@dataclass
class Meeting:
    """What a reader has of a camera with a fault.

    Attributes:
        camera: the camera.
        usable: different pictures of the right size that came.
        told: how it ended; empty where pictures came until it was left.
        seconds: how long that took.
    """

    camera: HostileCamera
    usable: int
    told: str
    seconds: float


def meet(fault: Fault, pictures: Sequence[bytes], seconds: float) -> Meeting:
    """Read a camera with this fault for some time, or until it is given up."""
    camera = HostileCamera(pictures, pictures[::-1], 1 / 30, fault=fault)
    begun, seen, told = time.monotonic(), set(), ""
    with hostile([camera]) as (address,):
        source = CameraAddress("cam0", address).source()
        with closing(source.shots()) as shots:  # type: ignore[type-var]
            try:
                for shot in shots:
                    if _is_usable(shot, _shape(pictures[0])[1::-1]):
                        seen.add(shot.jpeg)
                    if time.monotonic() - begun > seconds:
                        break
            except CaptureError as problem:
                told = str(problem)
        camera.fault = None
    return Meeting(camera, len(seen), told, time.monotonic() - begun)


def _is_usable(shot: Shot, wanted_wh: tuple[int, ...]) -> bool:
    if not is_whole(shot) or size_wh(shot) != wanted_wh:
        return False
    try:
        return image_of("cam0", 0, 0.0, shot).pixels is not None
    except SessionError:
        return False


def rows(count: int, seed: int) -> list[tuple[str, str]]:
    """Meet `count` cameras; what their faults were, and what was told."""
    draw = random.Random(seed)
    pictures = [
        cv2.imencode(".jpg", np.random.default_rng(k).integers(0, 255, (120, 160, 3), np.uint8))[1]
        for k in range(12)
    ]
    faults = [draw.choice(FAULTS) for _ in range(count)]
    with ThreadPoolExecutor(8) as pool:
        met = list(pool.map(lambda one: meet(one, [p.tobytes() for p in pictures], 3.0), faults))
    out = []
    for fault in dict.fromkeys(faults):
        some = [one for one, other in zip(met, faults, strict=True) if other is fault]
        texts = {re.sub(r"http://\S+: ", "", one.told) or _came(one) for one in some}
        longest = max(one.seconds for one in some)
        leaks = sum(map(_leaks, some))
        out.append(
            (
                f"{fault.name} ({len(some)})",
                f"{'; '.join(sorted(texts))} (within {longest:.1f} s)" + " LEAKS" * bool(leaks),
            )
        )
    return out


def _came(one: Meeting) -> str:
    return "usable pictures came" if one.usable > 1 else "no usable pictures came"


def _leaks(one: Meeting) -> bool:
    return bool(one.camera.leaked) or any(w in one.told for w in (LOGIN.split(":")[1], TOKEN))
