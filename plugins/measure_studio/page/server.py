"""The server of the set-up page."""

from __future__ import annotations

import re
import secrets
import signal
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import resources
from pathlib import Path
from urllib.parse import quote
from urllib.request import ProxyHandler, build_opener

import uvicorn
from fastapi import FastAPI
from nicegui import app as pages
from nicegui import ui
from starlette.responses import FileResponse, PlainTextResponse, Response

from measure import api
from measure.errors import ConfigError, MeasureError
from measure.limits import PATIENCE_S
from measure_studio import api as studio_api
from measure_studio.page import (
    body_page,
    calibration_page,
    cameras_page,
    help_page,
    marks_page,
    measure_page,
    recordings_page,
    world_page,
)
from measure_studio.page.bench import Bench
from measure_studio.page.door import OF_A_FILE, Door

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_PAGES = (".html", ".svg")  # What browsers run scripts of
_SERVED = (*_PAGES, ".csv", ".png", ".jpg", ".jpeg", ".bmp", ".webp", ".pdf")
_WIDEST_PX = 4000
_FOREIGN = re.compile(rb"<link[^>]*https://[^>]*>")  # In a page; browsers connect for its sake


def serve(
    folder: Path,
    registry: api.Registry,
    cameras: tuple[str, ...] = (),
    request: studio_api.CaptureRequest | None = None,
    at: tuple[str, int] = ("127.0.0.1", 8080),
    seconds: float | None = None,
    tell: Callable[[str], None] = print,
) -> None:
    """Serve the set-up page until it is interrupted.

    Args:
        folder: where everything is written; made if it is not there.
        cameras: NAME=ADDRESS each; those of the last time if omitted.
        request: what cameras of this machine are set to.
        at: address and port to listen on; on any but loopback the page's address holds a token.
        seconds: how long; until interrupted if None.
        tell: called with the address of the page.

    Raises:
        ConfigError: nothing can listen there; or cameras that cannot be used.
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    host, port = at
    token = "" if host in _LOOPBACK else secrets.token_urlsafe(24)
    bench = Bench(folder, registry, not token, request or studio_api.CaptureRequest())
    with _listening(host, port) as listening:
        bench.load_cameras(cameras)
        query = f"?token={token}" if token else ""
        tell(f"http://{host}:{listening.getsockname()[1]}/{query}")
        config = uvicorn.Config(
            Door(_application(bench), token), log_level="warning", timeout_graceful_shutdown=1
        )
        pages.on_shutdown(bench.close)
        # The server hears interrupts and this, and raises them again when it has ended in order.
        signal.signal(signal.SIGTERM, lambda *_: None)
        server = uvicorn.Server(config)
        if seconds is not None:
            timer = threading.Timer(seconds, setattr, (server, "should_exit", True))
            timer.daemon = True
            timer.start()
        try:
            with suppress(KeyboardInterrupt):
                server.run([listening])
        finally:
            bench.close()  # the server does so, unless a closed terminal (SIGHUP) ended it


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        raise ConfigError(f"{host}, port {port}: nothing can listen there ({reason})") from None


def _application(bench: Bench) -> FastAPI:
    """All pages, the pictures of the cameras, and the files of the folder."""
    application = FastAPI(openapi_url=None)

    @application.get("/picture/{camera:path}")
    def picture(camera: str, width: int = 480) -> Response:
        found = bench.preview.shown(camera, min(max(width, 1), _WIDEST_PX))
        if found is None:
            return Response(status_code=204)
        return Response(found[0], media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    add_files(application, bench.folder)
    add_viewer(application, bench)
    static = resources.files("measure_studio") / "static"
    pages.add_static_files("/studio", str(static))
    for page in (
        cameras_page, calibration_page, world_page, marks_page, body_page, measure_page,
        recordings_page, help_page,
    ):  # fmt: skip
        page.add(bench)
    ui.run_with(
        application,
        title="triball studio",
        language="en-US",
        dark=None,
        reconnect_timeout=PATIENCE_S,
        show_welcome_message=False,
    )
    return application


def add_files(application: FastAPI, folder: Path) -> None:
    """Pictures, tables and pages that lie in the folder; pages as nobody's own (`OF_A_FILE`)."""

    @application.get("/file/{name:path}")
    def file(name: str) -> Response:
        try:
            path = api.inside(folder, name)
            is_there = path.suffix.lower() in _SERVED and path.is_file()
        except (MeasureError, OSError) as problem:  # outside, or no name that a file can have
            return PlainTextResponse(str(problem), 404)
        if not is_there:
            return PlainTextResponse(f"{name}: no such file", 404)
        is_page = path.suffix.lower() in _PAGES
        return FileResponse(
            path, headers={"Content-Security-Policy": OF_A_FILE} if is_page else None
        )


def add_viewer(application: FastAPI, bench: Bench) -> None:
    """The viewer's files by this server, as the door lets them ask no other for anything."""
    to_this_machine = build_opener(ProxyHandler({}))

    @application.get("/viewer/{name:path}")
    def viewer(name: str) -> Response:
        if not bench.viewer:
            return PlainTextResponse("the viewer is there while something is measured", 404)
        try:
            with to_this_machine.open(f"{bench.viewer.partition('?')[0]}/{quote(name)}") as found:
                content, kind = found.read(), found.headers["Content-Type"]
        except OSError as problem:  # no such file, or the viewer has just ended
            return PlainTextResponse(f"{name}: {problem}", 404)
        return Response(content if name else _FOREIGN.sub(b"", content), media_type=kind)
