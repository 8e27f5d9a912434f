"""Cameras of this machine: which there are, what they deliver, and their controls (Video4Linux).

Controls are exposure, focus and their like. All cameras of a USB bus share what it can carry.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from measure.errors import CaptureError

AUTO = "auto"  # The setting of a control that the camera sets by itself
EXTRA = "cameras' modes and controls need the extra 'cameras': pip install 'triball[cameras]'"
_LOOK_EVERY_S = 1.0
_READ_EVERY_S, _STEADY, _LONGEST_S = 0.1, 10, 6.0
"""Automatic control is steady when so many readings are the same; so long is it waited for."""
# By our name of a control: V4L2's, that of what makes it automatic, and the latter's values for off
# and on. Automatic exposure is a menu: 0 auto, 1 manual, 2 shutter, 3 aperture priority.
_KNOWN: dict[str, tuple[str, str, int, tuple[int, ...]]] = {
    "exposure": ("EXPOSURE_ABSOLUTE", "EXPOSURE_AUTO", 1, (3, 0)),
    "focus": ("FOCUS_ABSOLUTE", "FOCUS_AUTO", 0, (1,)),
    "white_balance": ("WHITE_BALANCE_TEMPERATURE", "AUTO_WHITE_BALANCE", 0, (1,)),
    "gain": ("GAIN", "AUTOGAIN", 0, (1,)),
    "power_line": ("POWER_LINE_FREQUENCY", "", 0, ()),
}


@dataclass(frozen=True)
class Control:
    """How a control stands, in the driver's units, and what it takes."""

    name: str  # exposure, focus, white_balance, gain, power_line; of others the driver's
    value: int
    minimum: int
    maximum: int
    step: int
    default: int
    choices: Mapping[int, str] = field(default_factory=dict)  # meaning of a menu's values
    automatic: bool | None = None  # whether the camera sets it by itself now; None if it cannot

    @property
    def setting(self) -> int | str:
        """What sets it to how it stands."""
        return AUTO if self.automatic else self.value

    @property
    def takes(self) -> str:
        """What it can be set to, for people."""
        menu = ", ".join(f"{value} ({text})" for value, text in self.choices.items())
        text = menu or f"{self.minimum} to {self.maximum} in steps of {self.step}"
        return text if self.automatic is None else f"{text}, or {AUTO}"

    def number(self, text: str) -> int:
        """The value that a number or a menu's text means; CaptureError if it takes none such."""
        word = {"off": "disabled"}.get(text.casefold(), text.casefold())
        for value, meaning in self.choices.items():
            if word in (str(value), *str(meaning).casefold().split()):
                return value
        value = int(text) if text.removeprefix("-").isdecimal() else self.minimum - 1
        if self.choices or not self.minimum <= value <= self.maximum:
            raise CaptureError(f"{self.name}={text}: it takes {self.takes}")
        return value


class DeviceControls:
    """The controls of a device, and what they are set to whenever it is opened.

    `wanted` has by name of a control a number, a menu's text, or `auto`.
    """

    def __init__(self, path: Path, wanted: Mapping[str, str] | None = None) -> None:
        self._path, self._wanted = path, dict(wanted or {})

    def read(self) -> dict[str, Control]:
        """How all stand now, by name."""
        with opened(self._path) as device:
            return {name: _stands(name, *pair) for name, pair in _pairs(device).items()}

    def apply(self) -> None:
        """Set what is wanted, and read it back; CaptureError for what is not taken."""
        if self._wanted:
            with opened(self._path) as device:
                there = _pairs(device)
                for name, text in self._wanted.items():
                    if name not in there:
                        raise CaptureError(f"there is no control '{name}', only {', '.join(there)}")
                    _set(name, *there[name], text)

    def lock(self) -> None:
        """Keep what automatic control has found, once that is steady, from now on."""
        found, same, until_s = self.read(), 0, time.monotonic() + _LONGEST_S
        while same < _STEADY and time.monotonic() < until_s:
            time.sleep(_READ_EVERY_S)
            before, found = found, self.read()
            same = same + 1 if found == before else 0
        self._wanted |= {name: str(one.value) for name, one in found.items() if one.automatic}
        self.apply()


@dataclass(frozen=True)
class ControlRecord:
    """How cameras' controls stood, by camera and name."""

    settings: Mapping[str, Mapping[str, int | str]]  # at first
    changed: dict[str, str] = field(default_factory=dict)  # a sentence for each that changed since


@contextmanager
def watched(cameras: Mapping[str, DeviceControls], lock: bool) -> Iterator[ControlRecord]:
    """Notice which controls change meanwhile; `lock` keeps what automatic control has found."""
    for one in cameras.values() if lock else ():
        one.lock()

    def read() -> dict[str, dict[str, Control]]:
        found = {}
        for name, controls in cameras.items():
            with suppress(
                CaptureError
            ):  # it is away, which is reported elsewhere, or cannot be asked
                found[name] = controls.read()
        return found

    def look() -> None:
        last = not begun
        while not last:
            last = over.wait(_LOOK_EVERY_S)
            for camera, controls in read().items():
                for name, then in begun.get(camera, {}).items():
                    if (now := controls.get(name, then).value) != then.value:
                        cure = ": --lock keeps what it has found" if then.automatic else ""
                        text = f"{camera} changed its {name} from {then.value} to {now}{cure}"
                        record.changed[f"{camera}.{name}"] = text

    begun, over = read(), threading.Event()
    record = ControlRecord({n: {k: c.setting for k, c in of.items()} for n, of in begun.items()})
    thread = threading.Thread(target=look, daemon=True, name="controls")
    thread.start()
    try:
        yield record
    finally:
        over.set()
        thread.join()


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A device of linuxpy; CaptureError, with its path, for what it refuses, or without linuxpy."""
    try:
        from linuxpy.video.device import Device

        with Device(path) as device:
            yield device
    except ImportError:
        raise CaptureError(EXTRA) from None
    except PermissionError:
        raise CaptureError(f"{path}: may be read by the group 'video' only: join it") from None
    except (OSError, RuntimeWarning, CaptureError) as problem:  # a warning: ranges without sense
        raise CaptureError(f"{path}: {getattr(problem, 'strerror', None) or problem}") from None


def _pairs(device: Any) -> dict[str, tuple[Any, Any]]:
    """By our names the device's controls of numbers and menus, each with its automatic one."""
    from linuxpy.video.device import ControlID, ControlType

    kinds = {ControlType.INTEGER, ControlType.BOOLEAN, ControlType.MENU, ControlType.INTEGER_MENU}
    others = {
        one.id: one
        for one in device.controls.values()
        if one.type in kinds and not (one.is_flagged_disabled or one.is_flagged_write_only)
    }
    found = {}
    for name, (control, automatic, *_) in _KNOWN.items():
        setter = others.pop(ControlID[automatic], None) if automatic else None
        if (known := others.pop(ControlID[control], None)) is not None:
            found[name] = known, setter
    return found | {one.config_name: (one, None) for one in others.values()}


def _stands(name: str, control: Any, automatic: Any) -> Control:
    facts = control.value, control.minimum, control.maximum, control.step, control.default
    value, *limits = map(int, facts)
    by_itself = None if automatic is None else int(automatic.value) in _KNOWN[name][3]
    return Control(name, value, *limits, dict(getattr(control, "data", {})), by_itself)  # type: ignore[call-arg, arg-type]


def _set(name: str, control: Any, automatic: Any, text: str) -> None:
    """Set a control, or let the camera set it; refuse what is not taken."""
    asked: int | str = AUTO
    *_, off, on = _KNOWN.get(name, (0, ()))
    if automatic is not None and text == AUTO:
        automatic.value = next(value for value in on if value in getattr(automatic, "data", on))
    else:
        asked = _stands(name, control, automatic).number(text)
        if not control.is_writeable:
            raise CaptureError(f"{name} cannot be set, only read")
        if automatic is not None and int(automatic.value) in on:
            automatic.value = off
        control.value = asked
    now = _stands(name, control, automatic)
    if now.setting != asked:
        raise CaptureError(f"{name}={text} was not taken: it is {now.setting} ({now.takes})")


DEV, SYS = Path("/dev"), Path("/sys")
_USABLE = 280 / 480  # Share of a USB bus' rate that pictures can have
_BITS = {"MJPG": 2.0, "JPEG": 2.0, "H264": 0.3, "HEVC": 0.3, "GREY": 8.0, "RGB3": 24.0}
"""A pixel; of what is compressed an estimate, for the pictures decide. All others have 16."""


@dataclass(frozen=True)
class Mode:
    """Pictures of one form and size."""

    form: str  # in V4L2's four letters: MJPG, YUYV, ...
    size_wh: tuple[int, int]
    rates_hz: tuple[float, ...]  # pictures a second, highest first; empty if unknown

    def mbit_s(self, rate_hz: float) -> float:
        """What it needs of a bus."""
        return 1e-6 * math.prod(self.size_wh) * _BITS.get(self.form, 16.0) * rate_hz


@dataclass(frozen=True)
class FoundCamera:
    """A camera, and what it says of itself."""

    name: str
    address: str  # for `record` and `live`; of a device the same after replugging
    path: str = ""  # where a device is now
    bus: str = ""  # the USB bus that it hangs on; empty if on none
    bus_mbit_s: float = 0.0
    now: Mode | None = None  # what it is set to or, over the network, delivers
    modes: tuple[Mode, ...] = ()
    controls: tuple[Control, ...] = ()
    own_clock: bool | None = None  # whether a network camera sends times; None of a device
    problem: str = ""  # why no more is known of it

    def asked(
        self, size_wh: tuple[int, int] | None, rate_hz: float | None
    ) -> tuple[Mode, float] | None:
        """The mode and the rate that such a request gives, motion JPEG first; None if unknown."""
        now = self.now or Mode("", (0, 0), ())
        own = () if size_wh else now.rates_hz
        fitting = [one for one in self.modes if one.size_wh == (size_wh or now.size_wh)]
        modes = sorted(fitting, key=lambda one: one.form != "MJPG")
        return next(
            ((m, rate) for m in modes for rate in (rate_hz, *own, *m.rates_hz) if rate), None
        )


def find_devices() -> list[FoundCamera]:
    """The cameras of this machine; CaptureError on Windows and macOS without a library."""
    if not sys.platform.startswith("linux"):
        return _named_devices()
    paths = sorted(DEV.glob("video*"), key=lambda path: (len(path.name), path.name))
    found = [(one, _usb(path)[2]) for path in paths if (one := _look_at(path)) is not None]
    often = Counter(identity for _, identity in found)
    return [replace(one, address=_lasting(one.path, often[who] == 1)) for one, who in found]


def bus_notes(
    cameras: Mapping[str, FoundCamera],
    sizes_wh: Mapping[str, tuple[int, int]],
    rate_hz: float | None,
) -> list[str]:
    """A sentence for each USB bus that cannot carry what is asked for, or is set if nothing is."""
    buses = defaultdict[tuple[str, float], dict[str, tuple[Mode, float]]](dict)
    for name, one in cameras.items():
        if one.bus and (asked := one.asked(sizes_wh.get(name), rate_hz)):
            buses[one.bus, _USABLE * one.bus_mbit_s][name] = asked
    notes = []
    for (bus, usable), asked_of in buses.items():
        needs = {name: mode.mbit_s(rate) for name, (mode, rate) in asked_of.items()}
        if sum(needs.values()) > usable:
            modes = [mode for mode, _ in asked_of.values()]
            fits = [
                f"--rate {rate:g} would fit, else use smaller pictures or"
                for rate in sorted(set.intersection(*(set(mode.rates_hz) for mode in modes)))
                if sum(mode.mbit_s(rate) for mode in modes) <= usable
            ]
            what = ", ".join(f"{name} {need:.0f}" for name, need in needs.items())
            notes.append(
                f"{bus} carries about {usable:.0f} Mbit/s of pictures and is asked for about "
                f"{sum(needs.values()):.0f} ({what}): "
                + (fits[-1] if fits else "use smaller pictures or")
                + " connect some of these cameras to another bus"
            )
    return notes


def _look_at(path: Path) -> FoundCamera | None:
    """What a device says of itself; None if it takes no pictures."""
    bus, mbit_s, _ = _usb(path)
    title = SYS / "class/video4linux" / path.name / "name"
    name = title.read_text().strip() if title.is_file() else path.name
    found = FoundCamera(name, str(path), str(path), bus, mbit_s)
    rates = defaultdict[tuple[str, tuple[int, int]], set[float]](set)
    try:
        with opened(path) as device:
            from linuxpy.video.device import BufferType, Capability

            if Capability.VIDEO_CAPTURE not in device.info.device_capabilities:
                return None
            for one in device.info.frame_types:
                key = one.pixel_format.human_str(), (one.width, one.height)
                rates[key] |= {float(one.max_fps)} - {0.0}
            now = device.get_format(BufferType.VIDEO_CAPTURE)
            rate = float(device.get_fps(BufferType.VIDEO_CAPTURE))
            return replace(
                found,
                name=device.info.card,
                now=Mode(now.pixel_format.human_str(), (now.width, now.height), (rate,)),
                modes=tuple(
                    Mode(kind, size, tuple(sorted(rates[kind, size], reverse=True)))
                    for kind, size in rates
                ),
                controls=tuple(DeviceControls(path).read().values()),
            )
    except CaptureError as problem:
        return replace(found, problem=str(problem))


def _usb(path: Path) -> tuple[str, float, tuple[str, ...]]:
    """A device's bus, the bus' rate in Mbit/s, and the device's maker, kind and serial number."""
    place = (SYS / "class/video4linux" / path.name / "device").resolve()
    for folder in (place, *place.parents):
        if (folder / "busnum").is_file():
            bus = f"usb{(folder / 'busnum').read_text().strip()}"
            (root,) = (one for one in (folder, *folder.parents) if one.name == bus)
            marks = (folder / name for name in ("idVendor", "idProduct", "serial"))
            identity = tuple(mark.read_text().strip() for mark in marks if mark.is_file())
            return bus, float((root / "speed").read_text()), identity
    return "", 0.0, (str(path),)


def _lasting(path: str, unique: bool) -> str:
    """The address of a device that survives replugging; its path if it has none."""
    # `by-id` is made of maker, kind and serial number: where cameras have all that in common only
    # the socket that they are in tells them apart.
    for folder in ("by-id", "by-path") if unique else ("by-path",):
        for link in sorted((DEV / "v4l" / folder).glob("*")):
            if link.resolve() == Path(path).resolve():
                return str(link)
    return path


def _named_devices() -> list[FoundCamera]:
    """The cameras of Windows or macOS: only their names are known."""
    try:
        from cv2_enumerate_cameras import enumerate_cameras, supported_backends
    except ImportError:
        raise CaptureError(EXTRA) from None
    # The last of Windows' two is DirectShow, by which cameras are opened.
    found = enumerate_cameras(supported_backends[-1])
    return [FoundCamera(one.name, f"camera:{one.name}", one.path or "") for one in found]
