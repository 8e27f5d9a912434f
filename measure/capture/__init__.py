"""Cameras that deliver pictures now: where they are, their clocks, recording, frame sets."""

from measure.capture.addresses import CameraAddress, parse_cameras
from measure.capture.cameras import CameraCount, Cameras
from measure.capture.gathering import Gathering
from measure.capture.outages import Outage
from measure.capture.recorder import Recorder, check_new

__all__ = [
    "CameraAddress", "CameraCount", "Cameras", "Gathering", "Outage", "Recorder", "check_new",
    "parse_cameras",
]  # fmt: skip
