"""Opening a recording that is written as it goes: to a file, to a viewer that runs, or both."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from measure.errors import ConfigError
from measure.model import Camera
from measure.viewing.blueprint import run_blueprint

CONNECT_WITHIN_S = 5.0
"""How long a viewer that was just started may take to listen."""


def open_recording(
    name: str,
    cameras: Sequence[Camera],
    path: Path | None = None,
    address: str | None = None,
    part_of: str | None = None,
) -> rr.RecordingStream:
    """A recording that is written as it goes: to a file, to a viewer that runs, or to both.

    Args:
        cameras: for the layout that travels inside.
        path: the .rrd file, overwritten; no viewer is needed for it.
        address: of a viewer, as `rerun+http://127.0.0.1:9876/proxy`.
        part_of: recordings of one such name are shown as one; a name of its own if omitted.

    Raises:
        ConfigError: no viewer listens at the address.
    """
    stream = rr.RecordingStream("triball", recording_id=part_of)
    if address is not None:
        check_listening(address)
    sinks: list[rr.FileSink | rr.GrpcSink] = [rr.FileSink(path)] if path else []
    sinks += [rr.GrpcSink(address)] if address else []
    stream.set_sinks(*sinks, default_blueprint=run_blueprint(cameras))
    stream.send_recording_name(name)
    return stream


def check_listening(address: str) -> None:
    """Refuse an address where no viewer is.

    Rerun itself would drop everything it cannot send, and only log that.

    Raises:
        ConfigError: as said.
    """
    host, port = _host_and_port(address)
    deadline = time.monotonic() + CONNECT_WITHIN_S
    while True:
        try:
            socket.create_connection((host, port), timeout=1.0).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise ConfigError(f"no viewer listens at {address}: {error.strerror}") from error
            time.sleep(0.1)


def _host_and_port(address: str) -> tuple[str, int]:
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or 9876
    except ValueError:
        host = None
    if host is None or not parts.scheme.startswith("rerun"):
        raise ConfigError(
            f"'{address}' is no viewer's address: expected rerun+http://127.0.0.1:9876/proxy"
        )
    return host, port
