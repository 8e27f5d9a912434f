"""Decoding pictures: a broken one is an error, never a half-grey image."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from measure.arrays import Bytes
from measure.errors import SessionError
from measure.session.files import missing_message

JPEG_START = b"\xff\xd8"
JPEG_SCAN, JPEG_END = b"\xff\xda", b"\xff\xd9"


def read_picture(path: Path | str) -> Bytes:
    """The BGR pixels (h, w, 3) of a picture file.

    Pixels are taken as the sensor gave them: an orientation tag is not applied, because the camera
    model belongs to the sensor.

    Raises:
        SessionError: missing, unreadable, empty, truncated or no picture.
    """
    return decode_picture(read_bytes(Path(path)), str(path))


def read_bytes(path: Path, where: str = "") -> bytes:
    """The bytes of a file that is not empty.

    Raises:
        SessionError: missing, unreadable or empty; the message starts with `where`.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise SessionError(where + missing_message(path)) from None
    except OSError as problem:
        raise SessionError(f"{where}{path}: cannot be read: {problem.strerror}") from None
    if not data:
        raise SessionError(f"{where}{path}: the file is empty (0 bytes)")
    return data


def is_complete_jpeg(data: bytes | bytearray) -> bool:
    """Whether it is a JPEG that has an end; most have it at the very end, quicker to see."""
    if not data.startswith(JPEG_START):
        return False
    return data.endswith(JPEG_END) or data.rfind(JPEG_END) > data.rfind(JPEG_SCAN)


def decode_picture(data: bytes, where: str) -> Bytes:
    """BGR pixels (h, w, 3) of an encoded picture.

    Raises:
        SessionError: truncated or not a picture; the message starts with `where`.
    """
    # OpenCV fills the rest of a truncated JPEG with grey and says nothing.
    if data.startswith(JPEG_START) and not is_complete_jpeg(data):
        raise SessionError(
            f"{where}: truncated JPEG ({len(data)} bytes, no end marker); "
            "remove the file, and its frame counts as missing"
        )
    pixels = cv2.imdecode(
        np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    )
    if pixels is None:
        raise SessionError(f"{where}: not a picture that can be decoded ({len(data)} bytes)")
    return np.asarray(pixels, dtype=np.uint8)
