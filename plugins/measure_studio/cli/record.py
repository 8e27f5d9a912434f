"""`measure record`: cameras into a session."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

from measure.cli import console
from measure.cli.console import JsonFlag, OutFile
from measure.cli.options import FIELDS
from measure.limits import MOST_LISTED
from measure.model import Image
from measure_studio import api as studio_api
from measure_studio.capture import CameraCount, Outage

FIELDS(studio_api.CaptureRequest)
LINE_EVERY_S = 2.0  # Between two lines of what has come
_UNEVEN_S = 2e-3  # Spread of the times of arrival, in s, from which a warning is printed


def record(
    *cameras: str,
    out: OutFile,
    calibration: Path | None = None,
    body: tuple[Path, ...] = (),
    reference: str = "",
    options: Annotated[studio_api.CaptureOptions, FIELDS] = studio_api.CaptureOptions(),
    spawn: bool = False,
    json: JsonFlag = False,
) -> None:
    """Record cameras into a session.

    JPEGs are kept as the cameras make them, a file each, with the time at which each arrived.
    Without `--seconds` it goes on until it is interrupted (Ctrl-C).

    Args:
        cameras: NAME=ADDRESS each: http://... of a motion-JPEG stream, rtsp://..., the number of a
            camera of this machine (0 for /dev/video0), or a video file, played at its own pace.
        out: the session's folder.
        calibration: the cameras' calibration, copied into the session as the bodies' files are;
            they may come later.
        body: the body's file; may be repeated for several bodies.
        reference: name of the body that the others are measured relative to.
        spawn: open the viewer, which shows the cameras' pictures.
    """
    names = () if calibration is None else studio_api.camera_names(calibration)
    given = studio_api.parse_cameras(cameras, names)
    for line in studio_api.usb_notes(given, calibration, options.request):
        console.note(line)
    with ExitStack() as stack:
        show = _preview([one.name for one in given], stack) if spawn else None
        report = stack.enter_context(console.progress("recording", "pictures"))
        recorded = studio_api.record(
            given,
            out,
            replace(options, on_image=show, on_outage=note_outage),
            calibration=calibration,
            bodies=body,
            reference=reference,
            on_state=lambda counts: report(sum(c.pictures for c in counts.values()), None),
        )
    if json:
        console.print_json(recorded)
        return
    print_cameras(recorded.cameras, recorded.changes)
    console.print_text(f"written to {out}; what is weak in it: measure check {out}")


def _preview(cameras: Sequence[str], stack: ExitStack) -> Callable[[Image], None]:
    """Open the viewer; returns what shows a picture there, until the stack is closed."""
    from measure.viewing.recording import LivePictures
    from measure.viewing.viewer import open_viewer

    shown = LivePictures(cameras, open_viewer([]).listens, console.note)
    stack.callback(shown.close)
    return shown.add


def note_outage(outage: Outage) -> None:
    """Say that a camera is away, or back."""
    console.note(outage.sentence())


def print_cameras(cameras: Mapping[str, CameraCount], changes: Sequence[str]) -> None:
    """Print the pictures of each camera, and notes on interruptions, times and controls."""
    console.print_table(
        ("camera", "pictures", "per s", "times are", "uneven ms"),
        [
            (
                name,
                one.pictures,
                _known(one.rate_hz),
                "its own" if one.own_clock else "of arrival",
                _known(1e3 * one.uneven_s),
            )
            for name, one in cameras.items()
        ],
    )
    for name, one in cameras.items():
        for line in _outage_lines(name, one.outages):
            console.print_text(line)
        if not one.own_clock and one.uneven_s > _UNEVEN_S:
            console.print_text(
                f"note: {name} sends no times of its own, and its pictures arrive unevenly: a body "
                f"that moves at 100 mm/s is seen {100 * one.uneven_s:.1f} mm beside where it was"
            )
        if one.refused:
            console.print_text(f"note: {one.refused} pictures of {name} were torn or out of order")
    for line in changes:
        console.print_text(f"note: {line}")


def _outage_lines(name: str, outages: Sequence[Outage]) -> Iterator[str]:
    """When a camera was away, and why."""
    if outages:
        times = "once" if len(outages) == 1 else f"{len(outages)} times"
        yield f"note: {name} was away {times}" + ", of late" * (len(outages) > MOST_LISTED)
    for one in outages[-MOST_LISTED:]:
        since = datetime.fromtimestamp(one.since_s).strftime("%H:%M:%S")
        lasted = "to the end" if one.lasts else f"for {one.until_s - one.since_s:.1f} s"
        yield f"  from {since} {lasted}: {one.reason}"


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
