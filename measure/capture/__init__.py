"""Cameras that deliver pictures now: where they are, their clocks, recording, frame sets."""

from measure.capture.addresses import CameraAddress, parse_cameras
from measure.capture.cameras import CameraCount, Cameras
from measure.capture.controls import Control, DeviceControls
from measure.capture.devices import FoundCamera, Mode, bus_notes, find_devices
from measure.capture.gathering import Gathering
from measure.capture.outages import Outage
from measure.capture.recorder import Recorder, check_names

__all__ = [
    "CameraAddress", "CameraCount", "Cameras", "Control", "DeviceControls",
    "FoundCamera", "Gathering", "Mode", "Outage", "Recorder", "bus_notes", "check_names",
    "find_devices", "parse_cameras",
]  # fmt: skip
