"""What an RTSP camera answers before it is given a password.

FFmpeg, which speaks RTSP for us, follows redirections by itself and takes the password along. So a
camera whose address holds one is asked without it first, and is refused if it redirects.
"""

from __future__ import annotations

import re
import socket
import ssl
from contextlib import closing
from urllib.parse import SplitResult, urlsplit

from measure.capture.sources import PATIENCE_S
from measure.capture.web_address import shown
from measure.errors import CaptureError

_PORTS = {"rtsp": 554, "rtsps": 322}
_REDIRECTION = re.compile(rb"RTSP/1\.\d 3\d\d")
_REQUESTS = ("OPTIONS", "DESCRIBE")


def refuse_redirection(address: str) -> None:
    """Refuse a camera that redirects, if its address holds a password.

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
            f"{shown(address)}: redirects to another address, where its password shall not go: "
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
            # As FFmpeg: cameras make their own certificates. Nothing secret is said here.
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            connection = context.wrap_socket(plain, server_hostname=parts.hostname)
        with closing(connection):
            connection.sendall("\r\n".join(lines).encode())
            return connection.recv(64)
