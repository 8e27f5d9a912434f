"""A stream asked for over HTTP: every step of it ends within a time and a number of bytes.

`http.client` reads the answer, whose own limits are a hundred headers of 64 KiB each, and none of
time: one byte every few seconds would hold it for days. So what it reads from counts both.
"""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPResponse, IncompleteRead
from typing import Any, cast

from measure.errors import CaptureError
from measure.limits import MOST_LETTERS
from measure_studio.capture.login import answer_to, connected
from measure_studio.capture.sources import PATIENCE_S
from measure_studio.capture.web_address import WebAddress, shown

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
                        said = _login(answer, first.login, place.target, where)
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


def _login(answer: HTTPResponse, login: tuple[str, str], target: str, where: str) -> str:
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
