"""Recording cameras into a session."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from measure.capture import CameraAddress, CameraCount, Cameras, Outage, Recorder, check_new
from measure.capture.sources import Source
from measure.errors import ConfigError
from measure.model import Camera
from measure.session import check_bodies, read_body, read_calibration

_POLL_S = 0.1
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class CaptureRequest:
    """Size and rate requested of cameras of this machine."""

    # of the pictures; that of the calibration if None and there is one.
    size_wh: tuple[int, int] | None = None
    rate_hz: float | None = None  # pictures a second; the camera's own if None


@dataclass(frozen=True)
class RecordedSession:
    """A recording that has ended."""

    session: Path
    cameras: Mapping[str, CameraCount]


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

    Raises:
        CaptureError: a camera cannot be reached or is of another size than calibrated; the folder
            cannot be written, or a camera's name cannot be a folder's.
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
    sources = sources_of(cameras, calibrated, request)
    with (
        # Nothing is lost yet if this is interrupted.
        Cameras(sources, sizes_of(calibrated), on_outage) as rig,
        until_stopped() as stop,
        Recorder(out, rig.addresses, measured, calibrated, reference) as recording,
    ):
        rig.begin([recording.add])
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
    return RecordedSession(out, rig.counts)


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
    if request != CaptureRequest() and not any(one.is_device for one in cameras):
        raise ConfigError("--size and --rate are for cameras of this machine, and none is given")
    return {
        one.name: one.source(request.size_wh or sizes.get(one.name), request.rate_hz)
        for one in cameras
    }


def camera_names(calibration: Path) -> tuple[str, ...]:
    """The cameras of a calibration, in its order; CalibrationError if it is broken."""
    return read_calibration(calibration).names


def parse_size(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT, px; ConfigError for anything else."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError(f"--size {text}: expected WIDTHxHEIGHT, such as 1280x720")
    return int(width), int(height)


def parse_receiver(text: str) -> tuple[str, int]:
    """Read HOST:PORT; ConfigError for anything else."""
    host, _, port = text.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 65_536):
        raise ConfigError(f"--send {text}: expected HOST:PORT, such as 127.0.0.1:5005")
    return host.strip("[]"), int(port)


@contextmanager
def until_stopped() -> Iterator[threading.Event]:
    """Turn the first interrupt (Ctrl-C) or termination of this process into an event.

    A second one ends the process as usual. Outside the main thread, the only one that receives
    signals, the event is never set.

    Yields:
        Set once the work is to stop.
    """
    stop = threading.Event()
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
