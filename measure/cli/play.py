"""`measure play`: a run replayed at its own pace."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import InjectedRegistry, SettingTexts


def play(
    run: Path,
    /,
    *,
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
    """Play a run at its own pace, into whatever takes poses and into the viewer.

    It ends with the run, or when it is interrupted (Ctrl-C).

    Args:
        run: the run's folder.
        rate: how many times as fast as it was recorded.
        loop: begin again at its end.
        wait_s: seconds before the first pose, so that receivers find where to connect.
        send: where every pose is sent, such as udp://127.0.0.1:5005; may be repeated.
        set_: a setting of a sink as SINK.NAME=VALUE, such as udp.format=osc; may be repeated.
        spawn: open the viewer and show the run.
        connect: show it in a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
    """
    viewer = connect
    if spawn:
        from measure.viewing.viewer import open_viewer

        viewer = open_viewer([]).listens
    to = send, set_, console.note
    options = api.PlayOptions(*to, rate=rate, loop=loop, wait_s=wait_s, viewer=viewer)
    end = api.play(run, registry, options)
    if json:
        console.print_json({"run": str(run), **vars(end)})
    else:
        console.print_text(
            f"{end.frame_sets} frame sets played, {1e3 * end.late_s:.1f} ms late at most"
        )
