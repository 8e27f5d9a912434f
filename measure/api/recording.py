"""Recording cameras into a session."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from measure.capture import (
    CameraAddress,
    CameraCount,
    Cameras,
    Outage,
    Recorder,
    bus_notes,
    check_new,
    find_devices,
)
from measure.capture.controls import watched
from measure.capture.sources import Source
from measure.errors import ConfigError
from measure.model import Camera, Image
from measure.session import check_bodies, read_body, read_calibration

_POLL_S = 0.1
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class CaptureRequest:
    """What is requested of cameras of this machine."""

    # of the pictures; that of the calibration if None and there is one.
    size_wh: tuple[int, int] | None = None
    rate_hz: float | None = None  # pictures a second; the camera's own if None
    # by camera ("" for all) and control (exposure, focus, white_balance, gain, power_line, or the
    # driver's name) a number, a menu's text or `auto`.
    controls: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    lock: bool = False  # whether what automatic control has found is kept from the start on

    def controls_of(self, camera: str) -> dict[str, str]:
        """What a camera's controls are set to."""
        return {**self.controls.get("", {}), **self.controls.get(camera, {})}


@dataclass(frozen=True)
class RecordedSession:
    """A recording that has ended."""

    session: Path
    cameras: Mapping[str, CameraCount]
    changes: tuple[str, ...] = ()  # a sentence for each control of a camera that changed meanwhile


def record(
    cameras: Sequence[CameraAddress],
    out: Path,
    *,
    calibration: Path | None = None,
    bodies: Sequence[Path] = (),
    reference: str = "",
    request: CaptureRequest | None = None,
    seconds: float | None = None,
    on_state: Callable[[Mapping[str, CameraCount]], None] | None = None,
    on_outage: Callable[[Outage], None] | None = None,
    on_image: Callable[[Image], None] | None = None,
    stop: threading.Event | None = None,
) -> RecordedSession:
    """Record cameras into a session folder for a time, or until the process is interrupted.

    Args:
        out: the session's folder, new or empty.
        calibration: copied into it; pictures of other sizes are refused. May be added later.
        bodies: likewise copied, one or several; may be added later.
        reference: name of the body that others are measured relative to; empty without one.
        request: what cameras of this machine are set to.
        seconds: how long; until interrupted if None.
        on_state: called ten times a second with the counts of all cameras.
        on_outage: called, from another thread, when a camera is away, and when it is back.
        on_image: called with every picture, from its camera's thread.
        stop: set to end it; interrupts set it, too.

    Raises:
        CaptureError: a camera cannot be reached, does not take a control, or is of another size
            than calibrated; the folder cannot be written, or a camera's name cannot be a folder's.
        CalibrationError: the calibration is broken, or has not all the cameras.
        SessionError: the body file is broken.
        ConfigError: no camera, or a time that is none.
    """
    check_seconds(seconds)
    check_new(out, [one.name for one in cameras])
    calibrated = calibrated_cameras(cameras, calibration)
    measured = [read_body(body) for body in bodies]
    if measured:
        check_bodies(measured, reference, "--body")
    sources, about = sources_of(cameras, calibrated, request), (measured, calibrated, reference)
    with (
        # Nothing is lost yet if this is interrupted.
        Cameras(sources, sizes_of(calibrated), on_outage) as rig,
        watched(rig.controls, request is not None and request.lock) as controls,
        until_stopped(stop) as stop,
        Recorder(out, rig.addresses, *about, controls.settings) as recording,
    ):
        rig.begin([recording.add] if on_image is None else [recording.add, on_image])
        begun = time.monotonic()
        while not rig.over and not stop.wait(_POLL_S):
            rig.check()
            if on_state is not None:
                on_state(rig.counts)
            if seconds is not None and time.monotonic() - begun >= seconds:
                break
        rig.check()
        rig.stop()
        rig.wait()  # what is counted is to be in the folder
    rig.check()
    return RecordedSession(out, rig.counts, tuple(controls.changed.values()))


def check_apart(record: Path, out: Path) -> None:
    """Refuse (ConfigError) to record into a run's folder, or into one that it lies in."""
    if record.resolve() in (out.resolve(), *out.resolve().parents):
        raise ConfigError(
            f"--record {record}: the run's folder, {out}, is the same or lies in it: a recording "
            "needs a folder of its own"
        )


def check_seconds(seconds: float | None) -> None:
    """Refuse a time that is not above 0, or no number (ConfigError)."""
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise ConfigError(f"--seconds {seconds:g}: expected a time above 0")


def calibrated_cameras(cameras: Sequence[CameraAddress], calibration: Path | None) -> list[Camera]:
    """The calibrations of cameras, in their order; none without a file.

    Raises:
        ConfigError: there is no camera.
        CalibrationError: the file is broken, or has not all of them.
    """
    if not cameras:
        raise ConfigError("no camera: give at least one, as NAME=ADDRESS")
    if calibration is None:
        return []
    known = read_calibration(calibration)
    return [known.camera(one.name) for one in cameras]


def sizes_of(cameras: Sequence[Camera]) -> dict[str, tuple[int, int]]:
    """Size in px of the pictures of calibrated cameras, by name."""
    sizes = {camera.name: camera.intrinsics.size_wh for camera in cameras}
    return {name: (int(size[0]), int(size[1])) for name, size in sizes.items()}


def sources_of(
    cameras: Sequence[CameraAddress], calibrated: Sequence[Camera], request: CaptureRequest | None
) -> dict[str, Source]:
    """What delivers each camera's pictures; nothing is opened yet.

    Raises:
        ConfigError: an impossible request, or no camera that takes one.
        CaptureError: there is no such camera or file.
    """
    request, sizes = request or CaptureRequest(), sizes_of(calibrated)
    if request.rate_hz is not None and not (math.isfinite(request.rate_hz) and request.rate_hz > 0):
        raise ConfigError(f"--rate {request.rate_hz:g}: expected pictures a second, above 0")
    devices = [one.name for one in cameras if one.is_device]
    if request != CaptureRequest() and not devices:
        raise ConfigError(
            "--size, --rate, --control and --lock are for cameras of this machine: none is given"
        )
    for name in request.controls:
        if name and name not in devices:
            first = next(iter(request.controls[name]))
            raise ConfigError(f"--control {name}.{first}: {name} is no camera of this machine")
    return {
        one.name: one.source(
            request.size_wh or sizes.get(one.name), request.rate_hz, request.controls_of(one.name)
        )
        for one in cameras
    }


def usb_notes(
    cameras: Sequence[CameraAddress], calibration: Path | None, request: CaptureRequest
) -> list[str]:
    """What a USB bus cannot carry of what is asked of cameras on it, with what would fit."""
    places = {one.name: Path(one.device).resolve() for one in cameras if one.is_device}
    if not places:
        return []
    there = {Path(one.path): one for one in find_devices()}
    known = {name: there[place] for name, place in places.items() if place in there}
    sizes = sizes_of(calibrated_cameras(cameras, calibration))
    asked = {name: request.size_wh or sizes.get(name) for name in known}
    return bus_notes(known, {name: size for name, size in asked.items() if size}, request.rate_hz)


def parse_controls(texts: Iterable[str]) -> dict[str, dict[str, str]]:
    """Read NAME=VALUE and CAMERA.NAME=VALUE, several with commas; ConfigError for all else."""
    found: dict[str, dict[str, str]] = {}
    for text in (part.strip() for several in texts for part in several.split(",")):
        key, _, value = text.partition("=")
        camera, _, name = key.rpartition(".")
        if not (name and value):
            raise ConfigError(f"--control {text}: expected NAME=VALUE, such as exposure=150")
        found.setdefault(camera, {})[name] = value
    return found


def camera_names(calibration: Path) -> tuple[str, ...]:
    """The cameras of a calibration, in its order; CalibrationError if it is broken."""
    return read_calibration(calibration).names


def parse_size(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT, px; ConfigError for anything else."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError(f"--size {text}: expected WIDTHxHEIGHT, such as 1280x720")
    return int(width), int(height)


@contextmanager
def until_stopped(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """Turn the first interrupt (Ctrl-C) or termination of this process into an event.

    A second one ends the process as usual. Outside the main thread, the only one that receives
    signals, the event is not set by it.

    Args:
        stop: the event; a new one if omitted.

    Yields:
        Set once the work is to stop.
    """
    stop = stop or threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        stop.set()
        for each, handler in before.items():
            signal.signal(each, handler)

    for number in _SIGNALS:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
