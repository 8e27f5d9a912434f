"""What delivers pictures: one address, one source."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes
from measure.model import Image
from measure.session import decode_picture, is_complete_jpeg
from measure.session.pictures import jpeg_size_wh
from measure_studio.capture.controls import DeviceControls

PATIENCE_S = 5.0  # A camera that has said nothing for so long is taken to be gone
RETRY_S = 1.0  # Wait before what broke off, a camera or a sink, is tried again
POLL_S = 0.1  # Between two looks at what comes by itself
RECENT = 32  # Latest steps of a camera from which its rate, and their jitter, are computed


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """A picture as a camera delivered it: either as its JPEG or as its pixels."""

    arrived_s: float  # when its last byte had arrived, on the clock of `time.monotonic`
    # its stamp on the camera's own clock, whatever that starts from; None without.
    device_s: float | None
    jpeg: bytes | None  # its bytes, as the camera compressed it; None if it did not
    pixels: Bytes | None = None  # BGR (h, w, 3), of a picture that is no JPEG


class Source(ABC):
    """Pictures from one address.

    Attributes:
        address: as it may be shown (`web_address.shown`).
        lasting: whether it goes on for ever unless something breaks; a file ends.
        settles: whether its first pictures are of no use: they come in bursts, their exposure and
            the camera's clock are not settled.
        keeps_time: whether pictures arrive when they were taken.
        controls: of a camera whose exposure and the like can be set here; None of others.
    """

    lasting = True
    settles = True
    keeps_time = False
    controls: DeviceControls | None = None

    def __init__(self, address: str) -> None:
        self.address = address

    def begin_at(self, time_s: float) -> None:  # noqa: B027 - cameras do not wait for us
        """Hear when the rig's sources begin, on the clock of `time.monotonic`."""

    @abstractmethod
    def shots(self) -> Iterator[Shot]:
        """Connect, yield pictures till the camera ends; CaptureError if it fails or is silent."""


def image_of(camera: str, frame: int, time_s: float, shot: Shot, time_sd_s: float = 0.0) -> Image:
    """A picture as the rest of the program takes it; decoded when its pixels are used."""
    where = f"camera '{camera}', frame {frame}"
    return Image(camera, frame, time_s, lambda: _pixels(shot, where), shot.jpeg, time_sd_s)


def is_whole(shot: Shot) -> bool:
    """Whether a picture is complete, by its end marker, and says how large it is."""
    if shot.jpeg is None:
        return True
    return is_complete_jpeg(shot.jpeg) and size_wh(shot) is not None


def size_wh(shot: Shot) -> tuple[int, int] | None:
    """Width and height of a picture, px; None if its JPEG states none."""
    if shot.pixels is not None:
        return shot.pixels.shape[1], shot.pixels.shape[0]
    return jpeg_size_wh(shot.jpeg or b"")


def _pixels(shot: Shot, where: str) -> Bytes:
    if shot.pixels is not None:
        return np.ascontiguousarray(shot.pixels)
    return decode_picture(shot.jpeg or b"", where)
