"""Size and completeness of a delivered picture without decoding it, and its pixels."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes
from measure.capture.sources import Shot
from measure.model import Image
from measure.session import decode_picture, is_complete_jpeg
from measure.session.pictures import jpeg_size_wh


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
