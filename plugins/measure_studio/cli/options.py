"""How cameras are read: options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass

from cyclopts import Parameter

from measure_studio import api

LINE_EVERY_S = 2.0  # Between two lines of what has come


@Parameter(name="*")
@dataclass(frozen=True)
class CameraOptions:
    """How long cameras are read, and what they are asked for.

    Attributes:
        seconds: stop after this long.
        size: WIDTHxHEIGHT to request from cameras of this machine; that of the calibration if
            omitted.
        rate: pictures per second to request from cameras of this machine.
        control: exposure=150,focus=auto or cam1.gain=0: settings for cameras of this machine, as
            `measure cameras` lists them; may be repeated.
        lock: lock the values that automatic control finds at the start.
    """

    seconds: float | None = None
    size: str | None = None
    rate: float | None = None
    control: tuple[str, ...] = ()
    lock: bool = False

    def request(self) -> api.CaptureRequest:
        """What is requested of the cameras."""
        size = None if self.size is None else api.parse_size(self.size)
        return api.CaptureRequest(size, self.rate, api.parse_controls(self.control), self.lock)
