"""Cameras of this machine, RTSP cameras, and video files played as if they were cameras."""

from __future__ import annotations

import re
import socket
import ssl
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, urlsplit

from measure.arrays import Bytes
from measure.errors import CaptureError, SessionError
from measure.session import open_video_stream
from measure.session.pictures import most_pixels
from measure_studio.capture.controls import DeviceControls
from measure_studio.capture.sources import PATIENCE_S, Shot, Source
from measure_studio.capture.web_address import shown

if TYPE_CHECKING:
    import av


class AvSource(Source):
    """What a video library opens: motion JPEG is kept as it comes, all else decoded."""

    def __init__(
        self, address: str, opened: str, options: Sequence[dict[str, str]], form: str | None = None
    ) -> None:
        """Make one; nothing is opened yet.

        Args:
            opened: as the library takes it.
            options: of the library; the first that it can open the address with.
            form: what kind of address it is, where the library cannot detect it.
        """
        super().__init__(address)
        self._opened, self._form, self._options = opened, form, tuple(options)

    def shots(self) -> Iterator[Shot]:
        """Pictures as they come, with the times the device, or the stream, gives them."""
        import av

        if self._form is None:
            refuse_redirection(self._opened)
        try:
            with self._container() as container:
                if not container.streams.video:
                    raise CaptureError(f"{self.address}: shows no picture")
                if self.controls is not None:
                    self.controls.apply()  # each time: what was unplugged has forgotten them
                for device_s, jpeg, pixels in _pictures(container):
                    yield Shot(time.monotonic(), device_s, jpeg, pixels)
        except (av.error.FFmpegError, OSError) as problem:
            # Not its text, in which the library writes the address as it was given.
            text = problem.strerror or type(problem).__name__
            raise CaptureError(f"{self.address}: {text}") from None

    def _container(self) -> av.container.InputContainer:
        import av

        open_with = partial(av.open, self._opened, format=self._form, timeout=PATIENCE_S)
        *firsts, last = self._options
        for options in firsts:
            with suppress(av.error.ArgumentError):
                return open_with(options=options)
        return open_with(options=last)


class FileSource(Source):
    """A video file, or a topic of a bag, at its own pace; all of a rig's begin at one moment."""

    lasting = settles = False
    keeps_time = True
    _begun_s: float | None = None

    def begin_at(self, time_s: float) -> None:
        """Play from the start at that moment."""
        self._begun_s = time_s

    def shots(self) -> Iterator[Shot]:
        """Its pictures, each when it is due."""
        begun = time.monotonic() if self._begun_s is None else self._begun_s
        try:
            stream = open_video_stream("", Path(self.address))
        except SessionError as problem:
            raise CaptureError(str(problem).removeprefix("camera '': ")) from None
        with closing(stream):
            for index, time_s in enumerate(stream.times_s - stream.begins_s):
                due = begun + float(time_s)
                time.sleep(max(due - time.monotonic(), 0.0))
                image = stream.read(index)
                pixels = None if image.encoded is not None else image.pixels
                yield Shot(due, None, image.encoded, pixels)


def device_source(
    address: str,
    size_wh: tuple[int, int] | None,
    rate_hz: float | None,
    controls: Mapping[str, str] | None = None,
) -> AvSource:
    """A camera of this machine, on Linux as motion JPEG if it can do that.

    Args:
        address: its path; `camera:` and its name on Windows and macOS.
        size_wh: of the pictures to ask for; the camera's own if None.
        rate_hz: pictures a second to ask for; the camera's own if None.
        controls: what `DeviceControls` sets.

    Raises:
        CaptureError: there is none, or its controls cannot be set here.
    """
    options = {}
    if size_wh is not None:
        options["video_size"] = f"{size_wh[0]}x{size_wh[1]}"
    if rate_hz is not None:
        options["framerate"] = f"{rate_hz:g}"
    if not sys.platform.startswith("linux"):
        if controls or not address.startswith("camera:"):
            raise CaptureError(
                f"camera {address}: on this system cameras are called as `measure cameras` lists "
                "them, and their controls cannot be set"
            )
        title, windows = address.removeprefix("camera:"), sys.platform == "win32"
        opened, form = (f"video={title}", "dshow") if windows else (title, "avfoundation")
        return AvSource(address, opened, [options], form)
    path = Path(address)
    if not path.exists():
        there = sorted(str(one) for one in Path("/dev").glob("video*"))
        others = f"; there is {', '.join(there)}" if there else ", nor any other at this computer"
        raise CaptureError(f"there is no camera {path}{others}")
    ways = [{**options, "input_format": "mjpeg"}, options]
    source = AvSource(str(path), str(path), ways, "v4l2")
    source.controls = DeviceControls(path, controls)
    return source


def rtsp_source(address: str) -> AvSource:
    """A network camera; by TCP, for pictures with gaps in them are of no use."""
    return AvSource(shown(address), address, [{"rtsp_transport": "tcp", "fflags": "nobuffer"}])


def _pictures(
    container: av.container.InputContainer,
) -> Iterator[tuple[float | None, bytes | None, Bytes | None]]:
    """Time on the device's clock, and the JPEG or the BGR pixels, of each picture."""
    stream = container.streams.video[0]
    keeps = stream.codec_context.name == "mjpeg"
    stream.codec_context.options = {"max_pixels": str(int(most_pixels()))}
    stream.codec_context.thread_count = 1  # several would hold as many pictures back
    for packet in container.demux(stream):
        if not keeps:
            for frame in packet.decode():
                yield _seconds(frame), None, frame.to_ndarray(format="bgr24")
        elif packet.size:
            yield _seconds(packet), bytes(packet), None


def _seconds(of: Any) -> float | None:
    return None if of.pts is None else float(of.pts * of.time_base)


_PORTS = {"rtsp": 554, "rtsps": 322}
_REDIRECTION = re.compile(rb"RTSP/1\.\d 3\d\d")
_REQUESTS = ("OPTIONS", "DESCRIBE")


def refuse_redirection(address: str) -> None:
    """Refuse a camera that redirects, if its address holds a password.

    FFmpeg, which speaks RTSP for us, follows redirections by itself and takes the password along.
    So such a camera is asked without it first.

    Raises:
        CaptureError: it redirects, or cannot be reached.
    """
    parts = urlsplit(address)
    if parts.username is None:
        return
    try:
        answers = [_answer(parts, request) for request in _REQUESTS]
    except (OSError, ValueError) as problem:
        text = getattr(problem, "strerror", None) or "no answer"
        raise CaptureError(f"{shown(address)}: {text}") from None
    if any(_REDIRECTION.match(answer) for answer in answers):
        raise CaptureError(
            f"{shown(address)}: redirects to another address, which must not get its password: "
            "give that address"
        )


def _answer(parts: SplitResult, request: str) -> bytes:
    """The first bytes of an answer."""
    place = (parts.hostname or "", parts.port or _PORTS[parts.scheme])
    host = parts.netloc.rpartition("@")[2]
    lines = [f"{request} {parts.scheme}://{host}{parts.path} RTSP/1.0", "CSeq: 1", "", ""]
    with closing(socket.create_connection(place, PATIENCE_S)) as plain:
        connection: socket.socket = plain
        if parts.scheme == "rtsps":
            context = ssl.create_default_context()
            # As FFmpeg: cameras make their own certificates. Nothing secret is sent here.
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            connection = context.wrap_socket(plain, server_hostname=parts.hostname)
        with closing(connection):
            connection.sendall("\r\n".join(lines).encode())
            return connection.recv(64)
