"""Controls of this machine's cameras (Video4Linux): exposure, focus and their like."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
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
