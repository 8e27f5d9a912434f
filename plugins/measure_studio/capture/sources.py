"""What delivers pictures, one source for one address: devices, RTSP cameras, video files.

A video file is played as if it were a camera. What may be a secret in an address is never shown.
"""

from __future__ import annotations

import re
import socket
import ssl
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, quote, unquote, urljoin, urlsplit

import numpy as np

from measure.arrays import Bytes
from measure.errors import CaptureError, SessionError
from measure.model import Image
from measure.session import decode_picture, is_complete_jpeg, open_video_stream
from measure.session.pictures import jpeg_size_wh, most_pixels
from measure_studio.capture.devices import DeviceControls

if TYPE_CHECKING:
    import av

_PARTS = re.compile(r"([a-z][\w+.-]*)://([^/?#]*)([^?#]*)(.*)", re.DOTALL | re.IGNORECASE)
_PORTS = {"http": 80, "https": 443}
_HIDDEN = "..."
_KEPT = "%/?:@!$&'()*+,;=-._~[]"
"""Signs of a request's target that are not escaped, beside letters and digits."""


def shown(address: str) -> str:
    """An address as messages, files and reports show it: without what may be a secret.

    User name, password and query are left out, and what follows an equals sign in the path. The one
    door for it: whatever holds an address shows it by this function.
    """
    parts = _PARTS.fullmatch(address)
    if parts is None:  # a file or a device, or an address without its scheme
        return re.sub(r"\?.*", f"?{_HIDDEN}", re.sub(r".*:.*@", "", address))
    scheme, host, path, rest = parts.groups()
    if "@" in path + rest:  # a password with unescaped signs ends nobody knows where
        return f"{scheme}://{_HIDDEN}"
    path = re.sub(r"=[^/]*", f"={_HIDDEN}", path)
    return f"{scheme}://{host.rpartition('@')[2]}{path}{f'?{_HIDDEN}' if rest[:1] == '?' else ''}"


@dataclass(frozen=True)
class WebAddress:
    """Where to ask for a stream over HTTP."""

    scheme: str  # `http` or `https`
    place: str  # host and port, the latter unless it is the scheme's own
    target: str = field(repr=False)  # path and query, escaped
    login: tuple[str, str] | None = field(default=None, repr=False)  # user name and password
    fragment: str = field(default="", repr=False)  # what follows a #, which is sent to nobody

    @classmethod
    def parse(cls, address: str) -> WebAddress:
        """Read one; ValueError if it is none of this kind: its text may hold the password."""
        parts = urlsplit(address)
        if parts.scheme not in _PORTS or not parts.hostname:
            raise ValueError("no http:// or https:// address")
        target = quote(parts.path or "/", _KEPT)
        if parts.query:
            target += f"?{quote(parts.query, _KEPT)}"
        login = None
        if parts.username is not None:
            login = unquote(parts.username), unquote(parts.password or "")
        host = parts.hostname.encode("idna").decode()
        place = f"[{host}]" if ":" in host else host
        if parts.port not in (None, _PORTS[parts.scheme]):
            place += f":{parts.port}"
        return cls(parts.scheme, place, target, login, parts.fragment)

    @property
    def origin(self) -> tuple[str, str]:
        """Whom a password given for this address is sent to."""
        return self.scheme, self.place

    @property
    def url(self) -> str:
        """The address without its login."""
        return f"{self.scheme}://{self.place}{self.target}"

    def redirected(self, location: str) -> WebAddress:
        """Where an answer's `Location` leads, without a login; ValueError if to no HTTP address."""
        return WebAddress.parse(urljoin(self.url, location))


PATIENCE_S = 5.0  # A camera that has said nothing for so long is taken to be gone
RETRY_S = 1.0  # Wait before what broke off, a camera or a sink, is tried again
POLL_S = 0.1  # Between two looks at what comes by itself
RECENT = 32  # Latest steps of a camera from which its rate, and their jitter, are computed


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """A picture as a camera delivered it: either as its JPEG or as its pixels."""

    arrived_s: float  # when its last byte had arrived, on the clock of `time.monotonic`
    # its stamp on the camera's own clock, whatever that starts from; None without.
    device_s: float | None
    jpeg: bytes | None  # its bytes, as the camera compressed it; None if it did not
    pixels: Bytes | None = None  # BGR (h, w, 3), of a picture that is no JPEG


class Source(ABC):
    """Pictures from one address.

    Attributes:
        address: as it may be shown (`web_address.shown`).
        lasting: whether it goes on for ever unless something breaks; a file ends.
        settles: whether its first pictures are of no use: they come in bursts, their exposure and
            the camera's clock are not settled.
        keeps_time: whether pictures arrive when they were taken.
        controls: of a camera whose exposure and the like can be set here; None of others.
    """

    lasting = True
    settles = True
    keeps_time = False
    controls: DeviceControls | None = None

    def __init__(self, address: str) -> None:
        self.address = address

    def begin_at(self, time_s: float) -> None:  # noqa: B027 - cameras do not wait for us
        """Hear when the rig's sources begin, on the clock of `time.monotonic`."""

    @abstractmethod
    def shots(self) -> Iterator[Shot]:
        """Connect, yield pictures till the camera ends; CaptureError if it fails or is silent."""


def image_of(camera: str, frame: int, time_s: float, shot: Shot, time_sd_s: float = 0.0) -> Image:
    """A picture as the rest of the program takes it; decoded when its pixels are used."""
    where = f"camera '{camera}', frame {frame}"
    return Image(camera, frame, time_s, lambda: _pixels(shot, where), shot.jpeg, time_sd_s)


def is_whole(shot: Shot) -> bool:
    """Whether a picture is complete, by its end marker, and says how large it is."""
    if shot.jpeg is None:
        return True
    return is_complete_jpeg(shot.jpeg) and size_wh(shot) is not None


def size_wh(shot: Shot) -> tuple[int, int] | None:
    """Width and height of a picture, px; None if its JPEG states none."""
    if shot.pixels is not None:
        return shot.pixels.shape[1], shot.pixels.shape[0]
    return jpeg_size_wh(shot.jpeg or b"")


def _pixels(shot: Shot, where: str) -> Bytes:
    if shot.pixels is not None:
        return np.ascontiguousarray(shot.pixels)
    return decode_picture(shot.jpeg or b"", where)


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


_RTSP_PORTS = {"rtsp": 554, "rtsps": 322}
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
    place = (parts.hostname or "", parts.port or _RTSP_PORTS[parts.scheme])
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
