"""Opening recordings in the Rerun viewer, native or in a browser, always on ports that are free."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from ipaddress import IPv4Address
from pathlib import Path

from measure.errors import ConfigError, RunError
from measure.limits import PATIENCE_S

LOOPBACK = "127.0.0.1"
_MAGIC = b"RRF"  # What every .rrd file begins with


@dataclass(frozen=True)
class Viewer:
    """A viewer that runs."""

    process: subprocess.Popen[bytes]  # the viewer itself, no wrapper: ending it ends the viewer
    address: str | None  # where a browser finds it; None for the native window
    listens: str  # where a running measurement can send to


def recording_of(run: Path) -> Path:
    """A run's recording, if it is a run's folder; or the file itself."""
    return run / "run.rrd" if run.is_dir() else run


def open_viewer(recordings: Sequence[Path], web: bool = False, bind: str = LOOPBACK) -> Viewer:
    """Start the viewer on .rrd files, in a window or served over HTTP.

    Rerun hands a recording to whatever viewer listens on its default port and quits without a word;
    therefore each viewer gets free ports of its own, at `bind`. Without files it waits to be sent
    something. RunError: a file is missing or no recording, or the viewer's program is missing.
    ConfigError: `bind` is no address of this machine.
    """
    for path in recordings:
        _refuse_what_is_no_recording(path)
    grpc_port, web_port = _free_ports(bind, 2)
    command = [viewer_program(), *map(str, recordings), "--bind", bind, "--port", str(grpc_port)]
    listens = f"rerun+http://{bind}:{grpc_port}/proxy"
    address = None
    if web:
        command += ["--serve-web", "--web-viewer-port", str(web_port)]
        address = f"http://{bind}:{web_port}?url={listens.replace('+', '%2B')}"
    # In a session of its own it outlives the Ctrl-C that ends a measurement.
    # Its log names other addresses than the one for browsers: RUST_LOG, which this package sets,
    # leaves that out.
    process = subprocess.Popen(command, stdout=sys.stderr, start_new_session=True)
    if web:
        _wait_until_served(process, bind, web_port)
    return Viewer(process, address, listens)


def _wait_until_served(process: subprocess.Popen[bytes], bind: str, port: int) -> None:
    """A page that is fetched before would stay empty."""
    until_s = time.monotonic() + PATIENCE_S
    with ExitStack() as unless_served:
        unless_served.callback(process.kill)
        while process.poll() is None and time.monotonic() < until_s:
            with socket.socket() as probe:
                if probe.connect_ex((bind, port)) == 0:
                    unless_served.pop_all()
                    return
            time.sleep(0.02)
    raise RunError(f"the Rerun viewer served nothing, and ended with code {process.wait()}")


def _refuse_what_is_no_recording(path: Path) -> None:
    if not path.is_file():
        raise RunError(f"{path}: no such recording; `measure run` writes run.rrd into its folder")
    with path.open("rb") as file:
        if not file.read(len(_MAGIC)).startswith(_MAGIC):
            raise RunError(f"{path} is no recording of a run (.rrd): `measure run` writes one")


def viewer_program() -> str:
    """Path of the viewer itself, not of the wrapper that outlives a kill; RunError without one."""
    spec = find_spec("rerun_cli")
    places = spec.submodule_search_locations if spec is not None else None
    for place in places or ():
        for name in ("rerun", "rerun.exe"):
            if (Path(place) / name).is_file():
                return str(Path(place) / name)
    raise RunError("the Rerun viewer is not installed; mend with: pip install rerun-sdk")


def _free_ports(bind: str, count: int) -> list[int]:
    """Ports that nothing listens on; held together so that they differ."""
    try:
        # The viewer takes no names, and we look for ports of IPv4.
        IPv4Address(bind)
    except ValueError:
        raise ConfigError(f"--bind {bind}: expected an address such as {LOOPBACK}") from None
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_STREAM) for _ in range(count)]
    try:
        for each in sockets:
            each.bind((bind, 0))
        return [int(each.getsockname()[1]) for each in sockets]
    except OSError as error:
        raise ConfigError(f"--bind {bind}: nothing can listen there ({error.strerror})") from None
    finally:
        for each in sockets:
            each.close()
