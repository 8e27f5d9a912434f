"""Cameras that deliver pictures now: where they are, their clocks, recording, frame sets."""

from measure.capture.addresses import CameraAddress, parse_cameras
from measure.capture.cameras import CameraCount, Cameras
from measure.capture.controls import Control, DeviceControls
from measure.capture.devices import FoundCamera, Mode, bus_notes, find_devices
from measure.capture.gathering import Gathering
from measure.capture.mjpeg_server import Feed, picture_part, serve_cameras
from measure.capture.outages import Outage
from measure.capture.recorder import Recorder, check_names, jpeg_of

__all__ = [
    "CameraAddress", "CameraCount", "Cameras", "Control", "DeviceControls", "Feed",
    "FoundCamera", "Gathering", "Mode", "Outage", "Recorder", "bus_notes", "check_names",
    "find_devices", "jpeg_of", "parse_cameras", "picture_part", "serve_cameras",
]  # fmt: skip
