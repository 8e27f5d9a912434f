"""Cameras of this machine: which there are, what they deliver, and whether their bus carries it."""

from __future__ import annotations

import math
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from measure.errors import CaptureError
from measure_studio.capture.controls import EXTRA, Control, DeviceControls, opened

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
