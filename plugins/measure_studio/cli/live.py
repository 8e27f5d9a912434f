"""`measure live`: measuring live, from running cameras."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

from measure.api import Measurement
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile
from measure.cli.options import FIELDS, InjectedRegistry, ProfileOptions, Recording, Spawn, viewer
from measure.cli.run import print_summary
from measure.errors import ConfigError
from measure_studio import api as studio_api
from measure_studio.api import LiveEnd, LiveState
from measure_studio.cli.record import LINE_EVERY_S, note_outage, print_cameras


@FIELDS
@dataclass(frozen=True)
class _LiveOptions(studio_api.LiveOptions):
    recording: Recording = True


def live(
    *cameras: str,
    out: OutFile,
    calibration: Path,
    body: tuple[Path, ...] = (),
    method: ProfileOptions = ProfileOptions(),
    spawn: Spawn = False,
    mark: bool = False,
    options: _LiveOptions = _LiveOptions(),
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Measure live, from running cameras.

    Every frame set becomes a row of the run as soon as its pictures are there. Where measuring is
    slower than the cameras, frame sets are left out. Without `--seconds` it goes on until it is
    interrupted (Ctrl-C).

    Args:
        cameras: NAME=ADDRESS each, two at least, as for `measure record`.
        out: the run's folder, made if it is not there.
        calibration: the cameras' calibration.
        body: the body's file; may be repeated for several bodies.
        mark: mark an event with Enter; the text typed before it names it.
    """
    schemes = {address.partition(":")[0] for address in options.send}
    ours = tuple(text for text in method.set_ if text.partition(".")[0] in schemes)
    chosen = replace(method, set_=tuple(t for t in method.set_ if t not in ours)).chosen()
    options = replace(
        options,
        marks=(*options.marks, *([studio_api.TYPED] if mark else [])),
        connect=viewer(options.connect, spawn),
        sink_settings=ours,
        on_note=console.note,
        on_outage=note_outage,
    )
    if not body:
        raise ConfigError("what is to be measured? give --body FILE")
    given = studio_api.parse_cameras(cameras, studio_api.camera_names(calibration))
    for line in studio_api.usb_notes(given, calibration, options.request):
        console.note(line)
    lines = _StateLines()
    end = studio_api.live(given, out, calibration, body, chosen, registry, options, lines)
    if json:
        console.print_json({"run": str(out), **end.summary.values(), **_numbers(end)})
    else:
        _print(end, out)


class _StateLines:
    """A line on stderr every few seconds: position and its SD, and the age of the pose.

    And one, once, for what is wrong with the rig.
    """

    def __init__(self) -> None:
        self._last, self._said = time.monotonic(), set[tuple[str, str]]()

    def __call__(self, state: LiveState) -> None:
        now = time.monotonic()
        for cause in state.causes[:1]:
            if (cause.cause, cause.of) not in self._said:
                self._said.add((cause.cause, cause.of))
                console.note(str(cause.finding))
        if now - self._last >= LINE_EVERY_S:
            self._last = now
            out = {*state.away, *(name for one in state.latest for name in one.copies)}
            there = f"{len(state.cameras) - len(out)} of {len(state.cameras)} cameras"
            away = f" ({', '.join(_missing(state))})" if _missing(state) else ""
            console.note("; ".join([*map(_where, state.latest), there + away, _pace(state)]))


def _missing(state: LiveState) -> list[str]:
    """The cameras that are away, and why where pictures come all the same."""
    copies = {name: whose for one in state.latest for name, whose in one.copies.items()}
    away = [name for name in state.away if name not in copies]
    out = [f"{', '.join(away)} away"] if away else []
    return out + [f"{name} shows the pictures of {whose}" for name, whose in copies.items()]


def _where(latest: Measurement) -> str:
    if latest.pose is None:
        return f"{latest.status.value}: {latest.reason}"
    x, y, z = latest.pose.world_from_body.translation
    text = f"{x:.2f} {y:.2f} {z:.2f} mm (SD {latest.pose.position_sd_mm:.3f})"
    return text if not latest.pose.flags else f"{text}, doubtful: {'; '.join(latest.pose.flags)}"


def _pace(state: LiveState) -> str:
    pace = "" if math.isnan(state.rate_hz) else f"{state.rate_hz:.1f} frame sets per s, "
    return f"{pace}known after {1e3 * state.age_s:.0f} ms"


def _numbers(end: LiveEnd) -> dict[str, object]:
    names = ("rate_hz", "age_s", "overtaken", "unreadable", "cameras")
    known = {} if end.state is None else {name: getattr(end.state, name) for name in names}
    return {**known, "changes": end.changes, "sent": end.sent}


def _print(end: LiveEnd, out: Path) -> None:
    print_summary(end.summary)
    if end.state is not None:
        console.print_text(_pace(end.state))
        print_cameras(end.state.cameras, end.changes)
        if end.state.overtaken:
            console.print_text(
                f"note: {end.state.overtaken} frame sets were left out for newer ones"
            )
        if end.state.unreadable:
            console.print_text(f"note: {end.state.unreadable} pictures could not be decoded")
    console.print_text(f"written to {out}; look at it with: measure view {out}")
