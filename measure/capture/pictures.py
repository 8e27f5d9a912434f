"""Size and completeness of a delivered picture without decoding it, and its pixels."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes
from measure.capture.sources import Shot
from measure.model import Image
from measure.session import decode_picture, is_complete_jpeg

_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers after which a JPEG states its size."""
_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})
"""Markers that nothing belongs to."""
_SCAN = 0xDA


def image_of(camera: str, frame: int, time_s: float, shot: Shot) -> Image:
    """A picture as the rest of the program takes it; decoded when its pixels are used."""
    where = f"camera '{camera}', frame {frame}"
    return Image(camera, frame, time_s, lambda: _pixels(shot, where), shot.jpeg)


def is_whole(shot: Shot) -> bool:
    """Whether a picture is complete, by its end marker."""
    return shot.jpeg is None or is_complete_jpeg(shot.jpeg)


def size_wh(shot: Shot) -> tuple[int, int] | None:
    """Width and height of a picture, px; None if its JPEG states none."""
    if shot.pixels is not None:
        return shot.pixels.shape[1], shot.pixels.shape[0]
    return _jpeg_size_wh(shot.jpeg or b"")


def _jpeg_size_wh(data: bytes) -> tuple[int, int] | None:
    """What stands in its frame header."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        kind = data[at + 1]
        if kind in _FRAME_HEADERS:
            height, width = data[at + 5 : at + 7], data[at + 7 : at + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        if kind == _SCAN:
            break
        if kind == 0xFF:  # a marker may be filled up with these
            at += 1
        else:
            at += 2 if kind in _ALONE else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _pixels(shot: Shot, where: str) -> Bytes:
    if shot.pixels is not None:
        return np.ascontiguousarray(shot.pixels)
    return decode_picture(shot.jpeg or b"", where)
