"""Cameras that deliver pictures now: where they are, their clocks, recording, frame sets."""

from measure_studio.capture.addresses import CameraAddress, parse_cameras
from measure_studio.capture.cameras import CameraCount, Cameras, Outage
from measure_studio.capture.devices import (
    Control,
    DeviceControls,
    FoundCamera,
    Mode,
    bus_notes,
    find_devices,
)
from measure_studio.capture.gathering import Gathering
from measure_studio.capture.mjpeg import Feed, picture_part, serve_cameras
from measure_studio.capture.recorder import Recorder, check_names, jpeg_of

__all__ = [
    "CameraAddress", "CameraCount", "Cameras", "Control", "DeviceControls", "Feed",
    "FoundCamera", "Gathering", "Mode", "Outage", "Recorder", "bus_notes", "check_names",
    "find_devices", "jpeg_of", "parse_cameras", "picture_part", "serve_cameras",
]  # fmt: skip
