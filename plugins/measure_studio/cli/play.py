"""`measure play`: a run or a session replayed at its own pace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import FIELDS, InjectedRegistry, Spawn, viewer
from measure.errors import ConfigError
from measure_studio import api


def play(
    run: Path,
    /,
    *,
    as_cameras: bool = False,
    port: int = api.CAMERA_PORT,
    options: Annotated[api.PlayOptions, FIELDS] = api.PlayOptions(),
    set_: tuple[str, ...] = (),
    spawn: Spawn = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Play a run to receivers of poses and the viewer, or a session as web cameras.

    It ends with the run, or when it is interrupted (Ctrl-C). With `--as-cameras` the cameras of a
    session are served to this computer as motion JPEG over HTTP, at their own stamps; printed is
    what `measure live`, `record` and `studio` take as cameras. The session begins when the first of
    them is read, or with `--loop` at once.

    Args:
        run: the run's folder; with `--as-cameras` the session's.
        as_cameras: serve the cameras of a session.
        port: where they are served; 0 for any that is free.
        set_: a setting of a sink as SINK.NAME=VALUE, such as udp.format=osc; may be repeated.
    """
    if as_cameras:
        if options.send or spawn or options.connect:
            raise ConfigError(
                "--as-cameras serves pictures, no poses: leave out --send, --spawn and --connect"
            )
        _play_cameras(run, options, port, json)
        return
    connect = viewer(options.connect, spawn)
    options = replace(options, connect=connect, sink_settings=set_, on_note=console.note)
    end = api.play(run, registry, options)
    if json:
        console.print_json({"run": str(run), **vars(end)})
    else:
        console.print_text(
            f"{end.frame_sets} frame sets played, {1e3 * end.late_s:.1f} ms late at most"
        )


def _play_cameras(session: Path, pace: api.Pace, port: int, json: bool) -> None:
    """Serve a session's cameras, and print their addresses at once: others wait for them."""
    tell = console.note if json else console.print_text
    sent = api.play_cameras(session, pace, port, tell)
    if json:
        console.print_json({"session": str(session), "pictures": sent})
    else:
        counts = ", ".join(f"{name} {count}" for name, count in sent.items())
        console.print_text(f"pictures sent: {counts}")
