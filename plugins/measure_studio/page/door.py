"""Who may come in: this machine alone, or whoever knows the token; no page of another site.

And what goes out: the pages may ask this server alone.
"""

from __future__ import annotations

import hmac
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_LOOPBACK = {"127.0.0.1", "localhost", "::1"}
_COOKIE = "studio"
_OWN = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "connect-src 'self' data: blob: http://127.0.0.1:*; frame-ancestors 'self'"
)
"""Content-Security-Policy: a page asks this server, and no other but a viewer on this machine; and
no page of another site shows it in a frame, where clicks would be stolen."""

OF_A_FILE = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; frame-ancestors 'self'"
)
"""Of pages that lie in the folder, which strangers may have written: they draw their figures, but
not as pages of this server (their origin is none), and ask nobody for anything."""


class Door:
    """Stands before an application and refuses what must not come in (403).

    Pages of other sites could reach a server on loopback through the browser of whoever uses it:
    by a name of theirs that leads to 127.0.0.1, or by a web socket. Both are seen by the headers.

    Args:
        token: what an address must hold once (`?token=...`), and a cookie from then on; empty for a
            server on loopback.
    """

    def __init__(self, app: ASGIApp, token: str = "") -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or answer it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", _OWN)
                headers.setdefault("X-Content-Type-Options", "nosniff")
                # No page of another site shows a picture or a file of this server.
                headers["Cross-Origin-Resource-Policy"] = "same-origin"
            await send(message)

        asked = HTTPConnection(scope)
        given = asked.query_params.get("token", "")
        held = given, asked.cookies.get(_COOKIE, "")
        is_known = any(hmac.compare_digest(one.encode(), self._token.encode()) for one in held)
        if self._is_foreign(asked.headers) or not is_known:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
                return
            text = "not let in: open the address that `measure studio` printed"
            await PlainTextResponse(text, 403)(scope, receive, answer)
        elif given and scope["type"] == "http":
            # The token leaves the address, so that it is in no history and no screenshot.
            # Two slashes at the begin would name another server.
            there = RedirectResponse("/" + scope["path"].lstrip("/\\"), 303)
            there.set_cookie(_COOKIE, given, httponly=True, samesite="strict")
            await there(scope, receive, answer)
        else:
            await self._app(scope, receive, answer)

    def _is_foreign(self, headers: Headers) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        try:
            named, from_there = urlsplit(f"//{host}").hostname, urlsplit(origin or "").netloc
        except ValueError:  # no addresses at all
            return True
        if named is None or "@" in host:  # no browser sends such a host
            return True
        if origin is not None and from_there != host:
            return True
        return not self._token and named not in _LOOPBACK
