"""`measure play`: a run or a session replayed at its own pace."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import InjectedRegistry, SettingTexts
from measure.errors import ConfigError


def play(
    run: Path,
    /,
    *,
    as_cameras: bool = False,
    port: int = api.CAMERA_PORT,
    rate: float = 1.0,
    loop: bool = False,
    wait_s: float = 1.0,
    send: tuple[str, ...] = (),
    set_: SettingTexts = (),
    spawn: bool = False,
    connect: str | None = None,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Play a run into whatever takes poses and the viewer, or a session as web cameras.

    It ends with the run, or when it is interrupted (Ctrl-C). With `--as-cameras` the cameras of a
    session are served to this computer as motion JPEG over HTTP, at their own stamps; printed is
    what `measure live`, `record` and `studio` take as cameras. The session begins when the first of
    them is read, or with `--loop` at once.

    Args:
        run: the run's folder; with `--as-cameras` the session's.
        as_cameras: serve the cameras of a session.
        port: where they are served; 0 for any that is free.
        rate: how many times as fast as it was recorded.
        loop: begin again at its end.
        wait_s: seconds before the first pose or picture, so that receivers are all there.
        send: where every pose is sent, such as udp://127.0.0.1:5005, igtl://, foxglove://,
            lsl:triball, zenoh:triball; may be repeated.
        set_: a setting of a sink as SINK.NAME=VALUE, such as udp.format=osc; may be repeated.
        spawn: open the viewer and show the run.
        connect: show it in a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
    """
    if as_cameras:
        if send or spawn or connect:
            raise ConfigError(
                "--as-cameras serves pictures, no poses: leave out --send, --spawn and --connect"
            )
        _play_cameras(run, api.PlayOptions(rate=rate, loop=loop, wait_s=wait_s), port, json)
        return
    viewer = connect
    if spawn:
        from measure.viewing.viewer import open_viewer

        viewer = open_viewer([]).listens
    options = api.PlayOptions(
        send, set_, console.note, rate=rate, loop=loop, wait_s=wait_s, viewer=viewer
    )
    end = api.play(run, registry, options)
    if json:
        console.print_json({"run": str(run), **vars(end)})
    else:
        console.print_text(
            f"{end.frame_sets} frame sets played, {1e3 * end.late_s:.1f} ms late at most"
        )


def _play_cameras(session: Path, options: api.PlayOptions, port: int, json: bool) -> None:
    """Serve a session's cameras, and print their addresses at once: others wait for them."""
    tell = console.note if json else console.print_text
    sent = api.play_cameras(session, options, port, tell)
    if json:
        console.print_json({"session": str(session), "pictures": sent})
    else:
        counts = ", ".join(f"{name} {count}" for name, count in sent.items())
        console.print_text(f"pictures sent: {counts}")
