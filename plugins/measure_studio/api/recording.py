"""Recording cameras into a session."""

# Annotations are no texts here: cyclopts reads them of records that inherit these in other modules.

import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from measure.api.outputs import check_folder, new_folder
from measure.errors import ConfigError
from measure.model import Body, Camera, Image
from measure.processes import until_stopped
from measure.session import Calibration, check_bodies, read_body, read_calibration
from measure_studio import capture
from measure_studio.capture.devices import ControlRecord, watched
from measure_studio.capture.sources import POLL_S, Source

SESSION = "session.toml"  # By which a recording's folder is known
_SIZE = re.compile("0*[1-9][0-9]*x0*[1-9][0-9]*")


@dataclass(frozen=True)
class CaptureRequest:
    """What is requested of cameras of this machine.

    Attributes:
        size: WIDTHxHEIGHT to request from cameras of this machine; that of the calibration if
            omitted.
        rate: pictures per second to request from cameras of this machine.
        control: exposure=150,focus=auto or cam1.gain=0: settings for cameras of this machine, as
            `measure cameras` lists them; may be repeated.
        lock: lock the values that automatic control finds at the start.
    """

    size: str | None = None
    rate: float | None = None
    control: tuple[str, ...] = ()
    lock: bool = False

    def __post_init__(self) -> None:
        if self.size is not None and not _SIZE.fullmatch(self.size):
            raise ConfigError(f"--size {self.size}: expected WIDTHxHEIGHT, such as 1280x720")
        if self.rate is not None and not (math.isfinite(self.rate) and self.rate > 0):
            raise ConfigError(f"--rate {self.rate:g}: expected pictures a second, above 0")
        _ = self.controls

    @property
    def size_wh(self) -> tuple[int, int] | None:
        """Width and height, px."""
        if self.size is None:
            return None
        width, height = map(int, self.size.split("x"))
        return width, height

    @property
    def controls(self) -> dict[str, dict[str, str]]:
        """By camera ("" for all) and control a number, a menu's text or `auto`."""
        found: dict[str, dict[str, str]] = {}
        for text in (part.strip() for several in self.control for part in several.split(",")):
            key, _, value = text.partition("=")
            camera, _, name = key.rpartition(".")
            if not (name and value):
                raise ConfigError(f"--control {text}: expected NAME=VALUE, such as exposure=150")
            found.setdefault(camera, {})[name] = value
        return found

    def controls_of(self, camera: str) -> dict[str, str]:
        """What a camera's controls are set to."""
        return {**self.controls.get("", {}), **self.controls.get(camera, {})}


@dataclass(frozen=True)
class CaptureOptions:
    """How cameras are read, whatever becomes of their pictures.

    Attributes:
        seconds: stop after this long.
        request: what cameras of this machine are set to.
        overwrite: Replace what is there.
        on_image: gets every picture, from its camera's thread.
        on_outage: called, from another thread, when a camera is away, and when it is back.
        stop: set to end it; interrupts set it, too.
    """

    seconds: float | None = None
    request: CaptureRequest = CaptureRequest()
    overwrite: bool = False
    on_image: Callable[[Image], None] | None = None
    on_outage: Callable[[capture.Outage], None] | None = None
    stop: threading.Event | None = None

    def check(self) -> None:
        """Refuse a time that is not above 0, or no number (ConfigError)."""
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ConfigError(f"--seconds {self.seconds:g}: expected a time above 0")


@dataclass(frozen=True)
class OpenRig:
    """Cameras that deliver."""

    cameras: capture.Cameras
    controls: ControlRecord
    stop: threading.Event
    options: CaptureOptions

    def begin(self, *takers: Callable[[Image], None]) -> Callable[[], bool]:
        """Hand pictures on from now; gives what tells whether it is over, and ends it in time."""
        more, seconds = self.options.on_image, self.options.seconds
        self.cameras.begin([*takers, more] if more else takers)
        ends_s = math.inf if seconds is None else time.monotonic() + seconds

        def over() -> bool:
            if self.stop.is_set() or time.monotonic() >= ends_s:
                self.cameras.stop()
            return self.cameras.over

        return over


@contextmanager
def open_rig(
    sources: Mapping[str, Source], calibrated: Sequence[Camera], options: CaptureOptions
) -> Iterator[OpenRig]:
    """Open cameras until the block ends; nothing is lost yet if that is interrupted."""
    with (
        capture.Cameras(sources, sizes_of(calibrated), options.on_outage) as rig,
        watched(rig.controls, options.request.lock) as controls,
        until_stopped(options.stop) as stop,
    ):
        yield OpenRig(rig, controls, stop, options)


@dataclass(frozen=True)
class RecordedSession:
    """A recording that has ended."""

    session: Path
    cameras: Mapping[str, capture.CameraCount]
    changes: tuple[str, ...] = ()  # a sentence for each control of a camera that changed meanwhile


def record(
    cameras: Sequence[capture.CameraAddress],
    out: Path,
    options: CaptureOptions | None = None,
    *,
    calibration: Path | None = None,
    bodies: Sequence[Path] = (),
    reference: str = "",
    on_state: Callable[[Mapping[str, capture.CameraCount]], None] = lambda _: None,
) -> RecordedSession:
    """Record cameras into a session folder for a time, or until the process is interrupted.

    Args:
        calibration: copied into the folder; pictures of other sizes are refused. May be added
            later.
        bodies: copied too, one or several; may be added later.
        reference: name of the body that others are measured relative to; empty without one.
        on_state: called ten times a second with the counts of all cameras.

    Raises:
        CaptureError: a camera cannot be reached, does not take a control, or is of another size
            than calibrated; the folder cannot be written, or a camera's name cannot be a folder's.
        CalibrationError: the calibration is broken, or has not all the cameras.
        SessionError: the body file is broken.
        ConfigError: no camera, a time that is none, or a folder that holds something.
    """
    options = options or CaptureOptions()
    options.check()
    check_folder(out, options.overwrite, SESSION)
    capture.check_names([one.name for one in cameras])
    rig_calibration = calibration_of(cameras, calibration)
    calibrated = rig_calibration.cameras
    measured = [read_body(body) for body in bodies]
    if measured:
        check_bodies(measured, reference, "--body")
    with open_rig(sources_of(cameras, calibrated, options.request), calibrated, options) as opened:
        rig = opened.cameras
        with new_recorder(out, opened, measured, rig_calibration, reference) as recorder:
            over = opened.begin(recorder.add)
            while not over():
                rig.check()
                on_state(rig.counts)
                opened.stop.wait(POLL_S)
            rig.check()
            rig.wait()  # what is counted is to be in the folder
    rig.check()
    return RecordedSession(out, rig.counts, tuple(opened.controls.changed.values()))


def new_recorder(
    out: Path, opened: OpenRig, bodies: Sequence[Body], calibration: Calibration, reference: str
) -> capture.Recorder:
    """Begin a recording; one that is replaced is gone when this one has begun."""
    addresses, settings = opened.cameras.addresses, opened.controls.settings
    with new_folder(out, opened.options.overwrite, SESSION):
        return capture.Recorder(out, addresses, bodies, calibration, reference, settings)


def check_apart(record: Path, out: Path) -> None:
    """Refuse (ConfigError) to record into a run's folder, or into one that it lies in."""
    if record.resolve() in (out.resolve(), *out.resolve().parents):
        raise ConfigError(
            f"--record {record}: the run's folder, {out}, is the same or lies in it: a recording "
            "needs a folder of its own"
        )


def calibration_of(
    cameras: Sequence[capture.CameraAddress], calibration: Path | None
) -> Calibration:
    """The calibration of cameras, in their order; of no camera without a file.

    Raises:
        ConfigError: there is no camera.
        CalibrationError: the file is broken, or has not all of them.
    """
    if not cameras:
        raise ConfigError("no camera: give at least one, as NAME=ADDRESS")
    if calibration is None:
        return Calibration(())
    known = read_calibration(calibration)
    return replace(known, cameras=tuple(known.camera(one.name) for one in cameras))


def sizes_of(cameras: Sequence[Camera]) -> dict[str, tuple[int, int]]:
    """Size in px of the pictures of calibrated cameras, by name."""
    sizes = {camera.name: camera.intrinsics.size_wh for camera in cameras}
    return {name: (int(size[0]), int(size[1])) for name, size in sizes.items()}


def sources_of(
    cameras: Sequence[capture.CameraAddress],
    calibrated: Sequence[Camera],
    request: CaptureRequest = CaptureRequest(),
) -> dict[str, Source]:
    """What delivers each camera's pictures; nothing is opened yet.

    Raises:
        ConfigError: an impossible request, or no camera that takes one.
        CaptureError: there is no such camera or file.
    """
    sizes = sizes_of(calibrated)
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
            request.size_wh or sizes.get(one.name), request.rate, request.controls_of(one.name)
        )
        for one in cameras
    }


def usb_notes(
    cameras: Sequence[capture.CameraAddress], calibration: Path | None, request: CaptureRequest
) -> list[str]:
    """What a USB bus cannot carry of what is asked of cameras on it, with what would fit."""
    places = {one.name: Path(one.device).resolve() for one in cameras if one.is_device}
    if not places:
        return []
    there = {Path(one.path): one for one in capture.find_devices()}
    known = {name: there[place] for name, place in places.items() if place in there}
    sizes = sizes_of(calibration_of(cameras, calibration).cameras)
    asked = {name: request.size_wh or sizes.get(name) for name in known}
    return capture.bus_notes(
        known, {name: size for name, size in asked.items() if size}, request.rate
    )


def camera_names(calibration: Path) -> tuple[str, ...]:
    """The cameras of a calibration, in its order; CalibrationError if it is broken."""
    return read_calibration(calibration).names
