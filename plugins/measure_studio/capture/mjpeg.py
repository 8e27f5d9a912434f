"""Motion JPEG over HTTP, as web cameras and `mjpg-streamer` serve it: JPEGs, one after the other.

The stream is read here, not by a video library: those invent times, and decode what can be kept as
the camera made it. The format is that of RFC 2046 (multipart), as Netscape's server push used it.

Every step of asking for a stream ends within a time and a number of bytes. `http.client` reads the
answer, whose own limits are a hundred headers of 64 KiB each, and none of time: one byte every few
seconds would hold it for days. So what it reads from counts both.

The same format serves pictures on loopback. There a camera is a feed: a function that begins to
give the parts of a `multipart/x-mixed-replace` answer, each when its turn has come. Every reader
gets one of its own.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import math
import re
import secrets
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from email.message import Message
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection, IncompleteRead
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from typing import Any, TypeAlias, cast
from urllib.parse import quote, unquote, urlsplit
from urllib.request import parse_http_list, parse_keqv_list

from measure.errors import CaptureError, ConfigError
from measure.limits import MOST_LETTERS
from measure.session.pictures import JPEG_END, is_complete_jpeg
from measure_studio.capture.sources import PATIENCE_S, Shot, Source, WebAddress, shown

_SCHEME = re.compile(r"(?:^|,)\s*(?=(?:Basic|Digest|Bearer|NTLM|Negotiate)\b)", re.IGNORECASE)
_CERTIFICATE = re.compile("-----BEGIN CERTIFICATE-----.*?-----END CERTIFICATE-----", re.DOTALL)
_HASHES = {"MD5": hashlib.md5, "SHA-256": hashlib.sha256}
_CLIENT_NONCE_BYTES = 8


def answer_to(challenges: Iterable[str], login: tuple[str, str], target: str) -> str:
    """What an `Authorization` header says to the first challenge that is understood.

    Args:
        challenges: the `WWW-Authenticate` headers; a camera that sends none is taken to ask for a
            basic login.
        login: user name and password.
        target: what is asked for with GET, as it is sent.

    Raises:
        ValueError: the camera asks for a login of another kind; the text names it.
    """
    asked = [one.strip() for line in challenges for one in _SCHEME.split(line) if one.strip()]
    for one in sorted(asked or ["Basic"], key=lambda text: text.lower().startswith("basic")):
        scheme, _, rest = one.partition(" ")
        if scheme.lower() == "basic":
            pair = ":".join(login).encode()
            return f"Basic {base64.b64encode(pair).decode()}"
        if scheme.lower() == "digest":
            known = parse_keqv_list([part for part in parse_http_list(rest) if "=" in part])
            answer = _digest({name.lower(): value for name, value in known.items()}, login, target)
            if answer:
                return answer
    raise ValueError(", ".join(one.partition(" ")[0] for one in asked))


def _digest(asked: dict[str, str], login: tuple[str, str], target: str) -> str:
    """RFC 7616, 3.4; empty for an algorithm or a protection of another kind."""
    algorithm, qops = asked.get("algorithm", "MD5"), asked.get("qop", "")
    make = _HASHES.get(algorithm.upper().removesuffix("-SESS"))
    protections = [one.strip().lower() for one in qops.split(",")]
    if make is None or "nonce" not in asked or (qops and "auth" not in protections):
        return ""

    def digest(*parts: str) -> str:
        return make(":".join(parts).encode()).hexdigest()

    user, realm, nonce = login[0], asked.get("realm", ""), asked["nonce"]
    client_nonce, count = secrets.token_hex(_CLIENT_NONCE_BYTES), "00000001"
    secret = digest(user, realm, login[1])
    if algorithm.upper().endswith("-SESS"):
        secret = digest(secret, nonce, client_nonce)
    once = (nonce, count, client_nonce, "auth") if qops else (nonce,)
    response = digest(secret, *once, digest("GET", target))
    said = {"username": user, "realm": realm, "nonce": nonce, "uri": target, "response": response}
    said |= {"opaque": asked["opaque"]} if "opaque" in asked else {}
    said |= {"cnonce": client_nonce} if qops or algorithm.upper().endswith("-SESS") else {}
    quoted = [f'{name}="{_escaped(value)}"' for name, value in said.items()]
    plain = [f"algorithm={algorithm}"] if "algorithm" in asked else []
    plain += ["qop=auth", f"nc={count}"] if qops else []
    return f"Digest {', '.join([*quoted, *plain])}"


def _escaped(text: str) -> str:
    """For a quoted string of a header, which holds bytes: those of UTF-8."""
    return text.replace("\\", "\\\\").replace('"', '\\"').encode().decode("latin-1")


def connected(place: WebAddress, trusted: str, where: str) -> HTTPConnection:
    """A connection to a camera.

    Args:
        trusted: what follows the # in its address: `sha256=` and the fingerprint of its own
            certificate, or `certificate=` and the file that holds it; empty: one that this
            computer knows.

    Raises:
        CaptureError: its certificate is another one, or the file holds none.
        OSError: it cannot be reached.
    """
    if place.scheme != "https":
        return HTTPConnection(place.place, timeout=PATIENCE_S)
    wanted = _fingerprint(trusted, where)
    context = _unverifying() if wanted else ssl.create_default_context()
    connection = HTTPSConnection(place.place, timeout=PATIENCE_S, context=context)
    try:
        connection.connect()
    except ssl.SSLCertVerificationError as problem:
        asked = HTTPSConnection(place.place, timeout=PATIENCE_S, context=_unverifying())
        with closing(asked):
            asked.connect()
            shown = hashlib.sha256(asked.sock.getpeercert(binary_form=True) or b"").hexdigest()
        raise CaptureError(
            f"{where}: its certificate is not to be verified ({problem.verify_message}). If it is "
            f"the camera's own, add to the address: #sha256={shown}"
        ) from None
    found = hashlib.sha256(connection.sock.getpeercert(binary_form=True) or b"").hexdigest()
    if wanted and found != wanted:
        connection.close()
        raise CaptureError(
            f"{where}: its certificate is another one than you trust: its SHA-256 is {found}"
        )
    return connection


def _unverifying() -> ssl.SSLContext:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _fingerprint(trusted: str, where: str) -> str:
    """SHA-256 of the certificate to trust, in hexadecimal digits; empty for none of its own."""
    kind, _, value = trusted.partition("=")
    digits = value.replace(":", "").lower()
    if kind == "sha256" and re.fullmatch("[0-9a-f]{64}", digits):
        return digits
    if kind == "certificate":
        try:
            text = Path(value).read_text("latin-1")
            first = _CERTIFICATE.search(text)
            return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first[0] if first else "")).hexdigest()
        except (OSError, ValueError) as problem:
            why = getattr(problem, "strerror", None) or "it holds no certificate (PEM)"
            raise CaptureError(f"{where}: {value}: {why}") from None
    if trusted:
        raise CaptureError(
            f"{where}: after # is expected sha256=FINGERPRINT, 64 hexadecimal digits, or "
            "certificate=FILE"
        )
    return ""


_HEAD_BYTES = 64 << 10
_REDIRECTIONS = frozenset({301, 302, 303, 307, 308})
_MAX_REDIRECTIONS = 4


class HttpStream(io.RawIOBase):
    """What a connection delivers, within an allowance; more of it is an error."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.allow("the head of its answer", PATIENCE_S, _HEAD_BYTES)

    def allow(self, what: str, seconds: float, size: int) -> None:
        """Let the next of it take so long, and be so many bytes.

        Args:
            seconds: all of it may take; silence of `PATIENCE_S` is an error in any case.
            size: in bytes, but for what is read ahead.
        """
        self._what, self._seconds, self._size = what, seconds, size
        self._until_s, self._left = time.monotonic() + seconds, size

    def readable(self) -> bool:
        """It is."""
        return True

    def makefile(self, *_: object) -> io.BufferedReader:
        """All that `http.client` asks of a socket to read an answer from."""
        return io.BufferedReader(self)

    def readinto(self, buffer: Any) -> int:
        """Receive some bytes; OSError if the allowance is used up, or the camera silent or gone."""
        if self._left <= 0:
            raise OSError(f"{self._what} is longer than {self._size} bytes")
        left_s = self._until_s - time.monotonic()
        if left_s > 0:
            self._connection.settimeout(min(left_s, PATIENCE_S))
            with suppress(TimeoutError):
                count = self._connection.recv_into(buffer, min(len(buffer), self._left))
                self._left -= count
                return count
        if left_s > PATIENCE_S:
            raise TimeoutError(f"silent for {PATIENCE_S:g} s")
        raise TimeoutError(f"{self._what} did not come to its end in {self._seconds:g} s")


@contextmanager
def open_stream(address: str) -> Iterator[tuple[HTTPResponse, HttpStream]]:
    """Ask for a stream, and follow redirections.

    Login and password go to the address that they were given for, and nowhere else; a camera that
    asks for a digest login gets no password at all.

    Yields:
        The answer with its head read, and what sets the limits of the rest.

    Raises:
        CaptureError: there is no such address, or it answers something else, or not in time.
    """
    where = shown(address)
    try:
        first = place = WebAddress.parse(address)
    except ValueError:
        raise CaptureError(
            f"{where}: invalid address: write special characters of user name and password as %XX"
        ) from None
    try:
        said = ""
        for _ in range(2 + _MAX_REDIRECTIONS):
            is_own = place.origin == first.origin
            with closing(connected(place, first.fragment if is_own else "", where)) as connection:
                _ask(connection, place.target, said)
                stream = HttpStream(connection.sock)
                answer = HTTPResponse(cast("socket.socket", stream), method="GET")
                with closing(answer):
                    answer.begin()
                    asks = answer.status == HTTPStatus.UNAUTHORIZED
                    if asks and first.login and is_own and not said:
                        said = _authorization(answer, first.login, place.target, where)
                    elif answer.status in _REDIRECTIONS:
                        place, said = _redirected(place, answer, where), ""
                    else:
                        _check_status(answer.status, first, place, where)
                        yield answer, stream
                        return
    except (OSError, ValueError, HTTPException) as problem:
        raise CaptureError(f"{where}: {_text(problem)}") from None
    raise CaptureError(f"{where}: redirects more than {_MAX_REDIRECTIONS} times")


def _ask(connection: HTTPConnection, target: str, login: str) -> None:
    headers = {"Accept": "*/*", "Connection": "close"}
    connection.request("GET", target, headers=headers | ({"Authorization": login} if login else {}))


def _authorization(answer: HTTPResponse, login: tuple[str, str], target: str, where: str) -> str:
    try:
        return answer_to(answer.headers.get_all("www-authenticate", ()), login, target)
    except ValueError as problem:
        raise CaptureError(
            f"{where}: asks for a login that is not spoken here ({str(problem)[:MOST_LETTERS]}): "
            "set it to digest or basic, or give its RTSP address"
        ) from None


def _redirected(place: WebAddress, answer: HTTPResponse, where: str) -> WebAddress:
    try:
        return place.redirected(answer.headers.get("location", ""))
    except ValueError:
        raise CaptureError(f"{where}: redirects to no address of HTTP") from None


def _check_status(status: int, first: WebAddress, place: WebAddress, where: str) -> None:
    """Refuse an answer that is none."""
    if status == HTTPStatus.OK:
        return
    phrase = HTTPStatus(status).phrase if status in set(HTTPStatus) else "an unknown status"
    text = f"{where}: answers {status} {phrase}"
    if place.origin != first.origin:
        text += f" after it redirected to {shown(place.url)}"
        text += ", where no password is sent: give that address" * bool(first.login)
    elif status == HTTPStatus.UNAUTHORIZED:
        refused = ", and refuses those of the address" * bool(first.login)
        text += f": asks for user and password{refused}: {first.scheme}://USER:PASSWORD@HOST/..."
    raise CaptureError(text)


def _text(problem: Exception) -> str:
    """What went wrong; no text that the camera sent, and no part of the address."""
    if isinstance(problem, OSError):
        return problem.strerror or str(problem) or type(problem).__name__
    if isinstance(problem, IncompleteRead):
        return "the stream broke off"
    if isinstance(problem, HTTPException):
        return "what it answers is no HTTP"
    return "invalid address or answer"


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
