"""`measure live`: cameras measured while they deliver."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.injected import InjectedRegistry
from measure.cli.record import print_cameras

if TYPE_CHECKING:
    from measure.api import LiveEnd, LiveState

_LINE_EVERY_S = 2.0


def live(
    *cameras: str,
    out: Annotated[Path, Parameter(name=("--out", "-o"))],
    calibration: Path,
    body: Path,
    profile: str = "precise",
    detector: str | None = None,
    triangulator: str | None = None,
    solver: str | None = None,
    set_: Annotated[tuple[str, ...], Parameter(name="--set")] = (),
    record: Path | None = None,
    send: str | None = None,
    images: str = "none",
    recording: Annotated[bool, Parameter(negative="--no-recording")] = True,
    spawn: bool = False,
    connect: str | None = None,
    seconds: float | None = None,
    size: str | None = None,
    rate: float | None = None,
    overwrite: bool = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Measure cameras while they deliver.

    Every frame set becomes a row of the run as soon as its pictures are there. Where measuring is
    slower than the cameras, frame sets are left out. Without `--seconds` it goes on until it is
    interrupted (Ctrl-C).

    Args:
        cameras: NAME=ADDRESS each, two at least, as for `measure record`.
        out: the run's folder, made if it is not there.
        calibration: the cameras' calibration.
        body: the body's file.
        profile: `precise`, `paper`, or the path of a profile of your own (.toml).
        detector: a detector plugin to use instead of the profile's.
        triangulator: likewise.
        solver: likewise, a pose solver.
        set_: a setting as STAGE.NAME=VALUE, such as detector.rays=128; may be repeated.
        record: a session folder, new or empty, to record the pictures into as well.
        send: HOST:PORT that every pose is sent to by UDP, as a JSON object.
        images: pictures to keep in the viewer's recording: none, all, or every N-th set.
        recording: write run.rrd for the viewer.
        spawn: open the viewer and watch.
        connect: send to a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
        seconds: stop after this long.
        size: WIDTHxHEIGHT to ask cameras of this machine for; that of the calibration if omitted.
        rate: pictures a second to ask cameras of this machine for.
        overwrite: throw an earlier run in the folder away.
    """
    from measure import api

    chosen = api.choose(
        api.load_profile(profile),
        {"detector": detector, "triangulator": triangulator, "solver": solver},
        set_,
    )
    options = api.LiveOptions(
        record=record,
        send=None if send is None else api.parse_receiver(send),
        seconds=seconds,
        asked=api.Asked(None if size is None else api.parse_size(size), rate),
        image_every=api.parse_images(images),
        recording=recording,
        viewer=api.spawn_viewer() if spawn else connect,
        overwrite=overwrite,
    )
    given = api.parse_cameras(cameras, api.camera_names(calibration))
    end = api.live(given, out, calibration, body, chosen, registry, options, _Lines())
    if json:
        console.print_json({"run": str(out), **end.summary.values(), **_numbers(end)})
    else:
        _print(end, out)


class _Lines:
    """A line on stderr every few seconds: where the body is, how surely, how late that is known."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def __call__(self, state: LiveState) -> None:
        now = time.monotonic()
        if now - self._last >= _LINE_EVERY_S:
            self._last = now
            console.note(f"{_where(state)}; {_pace(state)}")


def _where(state: LiveState) -> str:
    latest = state.latest
    if latest.pose is None:
        return f"{latest.status.value}: {latest.reason}"
    x, y, z = latest.pose.world_from_body.translation
    text = f"{x:.2f} {y:.2f} {z:.2f} mm (SD {latest.pose.position_sd_mm:.3f})"
    return text if not latest.pose.flags else f"{text}, doubtful: {'; '.join(latest.pose.flags)}"


def _pace(state: LiveState) -> str:
    pace = "" if math.isnan(state.rate_hz) else f"{state.rate_hz:.1f} frame sets per s, "
    return f"{pace}known after {1e3 * state.age_s:.0f} ms"


def _numbers(end: LiveEnd) -> dict[str, object]:
    if end.state is None:
        return {}
    return {
        "rate_hz": end.state.rate_hz,
        "age_s": end.state.age_s,
        "overtaken": end.state.overtaken,
        "unreadable": end.state.unreadable,
        "cameras": end.state.cameras,
    }


def _print(end: LiveEnd, out: Path) -> None:
    console.print_text(end.summary.sentence())
    for reason, count in end.summary.reasons.items():
        console.print_text(f"  {count} x {reason}")
    for note in end.summary.notes:
        console.print_text(f"note: {note}")
    if end.state is not None:
        console.print_text(_pace(end.state))
        print_cameras(end.state.cameras)
        if end.state.overtaken:
            console.print_text(
                f"note: {end.state.overtaken} frame sets were left out for newer ones"
            )
        if end.state.unreadable:
            console.print_text(f"note: {end.state.unreadable} pictures could not be decoded")
    console.print_text(f"written to {out}; look at it with: measure view {out}")
