"""Who may come in: this machine alone, or whoever knows the token; no page of another site."""

from __future__ import annotations

import hmac
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

_LOOPBACK = {"127.0.0.1", "localhost", "::1"}
_COOKIE = "studio"


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
        headers = Headers(scope=scope)
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if self._is_foreign(headers) or not self._knows(headers, given):
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
                return
            text = "not let in: open the address that `measure studio` printed"
            await PlainTextResponse(text, 403)(scope, receive, send)
        elif given and scope["type"] == "http":
            # The token leaves the address, so that it is in no history and no screenshot.
            there = RedirectResponse(scope["path"], 303)
            there.set_cookie(_COOKIE, given, httponly=True, samesite="strict")
            await there(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _is_foreign(self, headers: Headers) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        try:
            named, from_there = urlsplit(f"//{host}").hostname, urlsplit(origin or "").netloc
        except ValueError:  # no addresses at all
            return True
        if origin is not None and from_there != host:
            return True
        return not self._token and named not in _LOOPBACK

    def _knows(self, headers: Headers, given: str) -> bool:
        if not self._token:
            return True
        cookie: SimpleCookie = SimpleCookie()
        try:
            cookie.load(headers.get("cookie", ""))
        except CookieError:
            return False
        held = cookie[_COOKIE].value if _COOKIE in cookie else ""
        return any(hmac.compare_digest(one.encode(), self._token.encode()) for one in (given, held))
