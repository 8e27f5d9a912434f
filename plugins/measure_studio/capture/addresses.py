"""Cameras as a user names them: NAME=ADDRESS."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from measure.bags import is_bag, split_topic
from measure.errors import CaptureError, ConfigError
from measure.session import check_name
from measure_studio.capture.mjpeg import HttpSource
from measure_studio.capture.sources import FileSource, Source, device_source, rtsp_source, shown

_RANGE = re.compile(r"\[(\d+)-(\d+)\]")
_MOST_IN_RANGE = 16  # Twice as many cameras as a rig has
_SCHEMES = ("http", "https", "rtsp", "rtsps")


@dataclass(frozen=True)
class CameraAddress:
    """Where a camera's pictures come from."""

    name: str
    # http://... or https://... of a motion-JPEG stream, rtsp://..., the number or path of a camera
    # of this machine, a video file, or a topic of a bag (`bag.mcap#/cam0/image_raw`).
    address: str = field(repr=False)

    @property
    def is_device(self) -> bool:
        """Whether it is a camera of this machine."""
        return self.device.startswith(("/dev/", "camera:"))

    @property
    def device(self) -> str:
        """The address, where a number stands for a device of Linux."""
        return f"/dev/video{self.address}" if self.address.isdecimal() else self.address

    @property
    def holds_secret(self) -> bool:
        """Whether it may hold a password; what mjpg-streamer's addresses end with is none."""
        # What follows a # names the certificate that is trusted.
        plain = self.address.partition("#")[0] if "://" in self.address else self.address
        plain = plain.removesuffix("?action=stream")
        return shown(plain) != plain

    def below(self, folder: Path) -> CameraAddress:
        """The same; the path of a file is meant from `folder`."""
        if self.is_device or "://" in self.address:
            return self
        return CameraAddress(self.name, str(folder / self.address))

    def source(
        self,
        size_wh: tuple[int, int] | None = None,
        rate_hz: float | None = None,
        controls: Mapping[str, str] | None = None,
    ) -> Source:
        """What delivers its pictures; nothing is opened yet.

        Args:
            size_wh: of the pictures to ask a camera of this machine for.
            rate_hz: pictures a second, or None as above.
            controls: what it is to be set to, by name (`controls.DeviceControls`), or None.

        Raises:
            CaptureError: no such file or camera, or no address.
        """
        try:
            scheme = urlsplit(self.address).scheme
        except ValueError as problem:
            reason = "Invalid IPv6 URL" if "IPv6" in str(problem) else "invalid address"
            raise CaptureError(f"camera '{self.name}': {shown(self.address)}: {reason}") from None
        if scheme in ("http", "https"):
            return HttpSource(self.address)
        if scheme in ("rtsp", "rtsps"):
            return rtsp_source(self.address)
        if self.is_device:
            return device_source(self.device, size_wh, rate_hz, controls)
        file = split_topic(self.address)[0]
        if not (file.is_file() or is_bag(file)):
            raise CaptureError(
                f"camera '{self.name}': {shown(self.address)} is no video file or bag, no number "
                f"of a camera and no address ({', '.join(f'{one}://' for one in _SCHEMES)})"
            )
        return FileSource(self.address)


def parse_cameras(words: Iterable[str], names: Sequence[str] = ()) -> list[CameraAddress]:
    """Read cameras as NAME=ADDRESS, or as addresses alone.

    A range in an address of the network stands for several, as curl has it:
    `http://10.0.0.[5-8]:8080/`; the number at the end of their name counts with it.

    Args:
        names: those of a calibration, which addresses alone get in this order; cam0, cam1, ...
            without.

    Raises:
        ConfigError: a name is given twice, left empty or no name (`check_name`), or some cameras
            have names and some not.
    """
    pairs = [pair for word in words for pair in _counted(*_split(word))]
    named = [name is not None for name, _ in pairs]
    if any(named) and not all(named):
        raise ConfigError("give every camera a name (NAME=ADDRESS), or none")
    if not any(named):
        if names and len(names) != len(pairs):
            raise ConfigError(
                f"{len(pairs)} cameras without names, and the calibration has {len(names)} "
                f"({', '.join(names)}): say which they are, as {names[0]}=ADDRESS"
            )
        given = names or [f"cam{k}" for k in range(len(pairs))]
        return [CameraAddress(n, address) for n, (_, address) in zip(given, pairs, strict=True)]
    cameras = [CameraAddress(name or "", address) for name, address in pairs]
    for one in cameras:
        if not one.name or not one.address:
            raise ConfigError(f"{one.name}={shown(one.address)}: expected NAME=ADDRESS")
        if sum(other.name == one.name for other in cameras) > 1:
            raise ConfigError(f"two cameras are called '{one.name}'")
        try:
            check_name(one.name)
        except ValueError as problem:
            raise ConfigError(f"a camera's name: {problem}") from None
    return cameras


def _split(word: str) -> tuple[str | None, str]:
    """Name and address; an equals sign after a slash, colon or question mark is the address's."""
    name, equals, address = word.partition("=")
    if not equals or any(sign in name for sign in "/:?\\"):
        return None, word
    return name, address


def _counted(name: str | None, address: str) -> list[tuple[str | None, str]]:
    """The cameras that a range in an address stands for; ranges after the first count with it."""
    found = _RANGE.search(address) if "://" in address else None
    if found is None:
        return [(name, address)]
    low, high = int(found[1]), int(found[2])
    if not low <= high < low + _MOST_IN_RANGE:
        raise ConfigError(
            f"{shown(address)}: {found[0]} stands for no cameras: expected the lower number first, "
            f"and no more than {_MOST_IN_RANGE} of them"
        )

    def number(step: int, one: re.Match[str]) -> str:
        return f"{int(one[1]) + step:0{len(one[1])}d}"

    steps = range(high - low + 1)
    return [(_next_name(name, k), _RANGE.sub(partial(number, k), address)) for k in steps]


def _next_name(name: str | None, step: int) -> str | None:
    """The name so many after this one: cam2 after cam0."""
    if name is None:
        return None
    stem = name.rstrip("0123456789")
    return f"{stem}{int(name[len(stem) :] or 0) + step}"
