"""`measure studio`: the set-up page."""

from __future__ import annotations

import webbrowser
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure.cli import console
from measure.cli.options import FIELDS, InjectedRegistry
from measure.errors import ConfigError
from measure_studio import api


def studio(
    folder: Path = Path(),
    /,
    *cameras: str,
    port: int = 8080,
    browser: Annotated[bool, Parameter(negative="--no-browser")] = True,
    host: str = "127.0.0.1",
    seconds: float | None = None,
    request: Annotated[api.CaptureRequest, FIELDS] = api.CaptureRequest(),
    rendered: Annotated[str | None, Parameter(parse=False)] = None,
    registry: InjectedRegistry,
) -> None:
    """Set up and measure in the browser, from cameras on a desk to a measured object.

    It runs until it is interrupted (Ctrl-C). Only this machine can open it, unless `--host` says
    otherwise; then its address holds a token, and whoever has that can use the cameras and the
    folder.

    Args:
        folder: the folder to read and write; the current one if omitted.
        cameras: NAME=ADDRESS each, as for `measure record`; those of the last time if omitted.
        port: to listen on; 0 for any that is free.
        browser: open the page in a browser.
        host: address to listen on.
        seconds: stop after this long.
        rendered: instead of cameras, rendered ones that wave this board (or "body", that), on a
            new folder.
    """
    if find_spec("nicegui") is None:
        raise ConfigError("the page needs NiceGUI: pip install 'triball[studio]'")
    from measure_studio.page.server import serve

    def tell(address: str) -> None:
        console.print_text(address)
        if browser:
            webbrowser.open(address)

    with ExitStack() as stack:
        if rendered is not None:
            with console.progress("rendering, the first time only", "pictures") as report:
                made = stack.enter_context(api.demo_cameras(folder, rendered, report))
            folder, addresses = made
            cameras = tuple(f"{name}={address}" for name, address in addresses.items())
            waved = "press Wave the body"
            if rendered != api.WAVED_BODY:
                waved = f"choose the board {rendered}"
            console.note(f"{folder}: {waved} in step Calibration; Ctrl-C ends it")
        serve(folder, registry, cameras, request, (host, port), seconds, tell)
