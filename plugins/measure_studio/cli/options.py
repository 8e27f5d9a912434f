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
        size: WIDTHxHEIGHT to ask cameras of this machine for; that of the calibration if omitted.
        rate: pictures a second to ask cameras of this machine for.
        control: exposure=150,focus=auto or cam1.gain=0: what cameras of this machine are set to, as
            `measure cameras` lists it; may be repeated.
        lock: keep what their automatic control has found from the start on.
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
