"""A machine with cameras that are none: what linuxpy shows of devices, and what `/sys` holds."""

from __future__ import annotations

import errno
from types import SimpleNamespace

from linuxpy.video import device as linuxpy
from linuxpy.video.device import Capability, ControlID, ControlType, PixelFormat

SIZES = ((1920, 1080), (1280, 720), (640, 480))
RATES = (30.0, 15.0, 5.0)


class FakeControl:
    """A control of a driver that takes what is in range, and reports it."""

    is_flagged_disabled = is_flagged_write_only = False
    is_writeable = True

    def __init__(self, name, value, limits=(0, 255, 1), kind=ControlType.INTEGER, menu=None):
        self.id = ControlID[name]
        self.config_name, self.type = name.lower(), kind
        self.minimum, self.maximum, self.step = limits
        self.default = self.value = value
        if menu is not None:
            self.data, self.type = menu, ControlType.MENU


class StubbornControl(FakeControl):
    """It takes no value but its first."""

    value = property(lambda self: self.__dict__["first"], lambda self, value: self.keep(value))

    def keep(self, value):
        self.__dict__.setdefault("first", value)


def webcam_controls():
    exposure = {1: "Manual Mode", 3: "Aperture Priority Mode"}
    power = {0: "Disabled", 1: "50 Hz", 2: "60 Hz"}
    return [
        FakeControl("EXPOSURE_AUTO", 3, (0, 3, 1), menu=exposure),
        FakeControl("EXPOSURE_ABSOLUTE", 156, (3, 2047, 1)),
        FakeControl("FOCUS_AUTO", True, (0, 1, 1), ControlType.BOOLEAN),
        FakeControl("FOCUS_ABSOLUTE", 30, (0, 250, 5)),
        FakeControl("GAIN", 64),
        FakeControl("POWER_LINE_FREQUENCY", 2, (0, 2, 1), menu=power),
        FakeControl("BRIGHTNESS", 128),
    ]


class FakeDevice:
    """One camera; opening it is opening the only one there is."""

    def __init__(self, forms=(PixelFormat.MJPEG, PixelFormat.YUYV), refuses=None, captures=True):
        self.controls = {control.id: control for control in webcam_controls()}
        self._refuses = refuses
        self.info = SimpleNamespace(
            card="HD Webcam",
            device_capabilities=Capability.VIDEO_CAPTURE if captures else Capability.META_CAPTURE,
            frame_types=[
                linuxpy.FrameType(1, form, *size, rate, rate, rate)
                for form in forms
                for size in SIZES
                for rate in RATES
            ],
        )

    def __enter__(self):
        if self._refuses:
            raise OSError(self._refuses, "Permission denied")
        return self

    def __exit__(self, *_):
        pass

    def get_format(self, kind):
        return linuxpy.Format(1280, 720, PixelFormat.YUYV, 0, 0)

    def get_fps(self, kind):
        return 30.0

    def control(self, name):
        return self.controls[ControlID[name]]


def machine(patch, tmp_path, devices, serials=()):
    """Put devices at /dev/video0 and on, all on one bus; returns their paths."""
    dev, sys = tmp_path / "dev", tmp_path / "sys"
    for name in ("DEV", "SYS"):
        patch.setattr(f"measure_studio.capture.devices.{name}", {"DEV": dev, "SYS": sys}[name])
    (dev / "v4l/by-id").mkdir(parents=True)
    (dev / "v4l/by-path").mkdir()
    root = sys / "devices/usb1"
    root.mkdir(parents=True)
    (root / "speed").write_text("480\n")
    by_path = {}
    for k, device in enumerate(devices):
        by_path[dev / f"video{k}"] = device
        (dev / f"video{k}").touch()
        hub = root / f"1-{k}"
        (hub / f"1-{k}:1.0").mkdir(parents=True)
        for mark, text in (("busnum", "1"), ("idVendor", "046d"), ("idProduct", "082d")):
            (hub / mark).write_text(text + "\n")
        if serials[k : k + 1] not in ((), ("",)):
            (hub / "serial").write_text(serials[k])
            link = dev / f"v4l/by-id/usb-HD_Webcam_{serials[k]}-video-index0"
            link.unlink(missing_ok=True)
            link.symlink_to(dev / f"video{k}")
        (dev / f"v4l/by-path/pci-usb-0:{k}:1.0-video-index0").symlink_to(dev / f"video{k}")
        place = sys / f"class/video4linux/video{k}"
        place.mkdir(parents=True)
        (place / "name").write_text("HD Webcam\n")
        (place / "device").symlink_to(hub / f"1-{k}:1.0")
    patch.setattr(linuxpy, "Device", lambda path: by_path[path.resolve()])
    return list(by_path)


DENIED = errno.EACCES
