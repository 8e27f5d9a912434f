"""Decoding pictures: a broken one is an error, never a half-grey image."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import IFD, Base
from PIL.ImageFile import ImageFile
from PIL.Jpeg2KImagePlugin import Jpeg2KImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from measure.arrays import Bytes
from measure.errors import SessionError
from measure.reading import read_bytes

JPEG_START = b"\xff\xd8"
_PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_SCAN, JPEG_END = b"\xff\xda", b"\xff\xd9"
LIMIT = "MEASURE_MAX_MEGAPIXELS"
"""The variable of the environment that raises the largest size of a picture."""
_DEFAULT_MEGAPIXELS = 100.0
_MAX_BYTES = 1 << 30
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers after which a JPEG states its size."""
_SEGMENT = re.compile(rb"\xff+([\xc0-\xcf\xd9-\xfe])")  # All markers but those that stand alone
_AFTER_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xdc\xff]", re.DOTALL)
"""Within a scan only a restart or the number of lines may stand (ITU-T T.81, B.1.1)."""
_READERS = (
    (JPEG_START, JpegImageFile),
    (_PNG_START[:4], PngImageFile),
    (b"BM", BmpImageFile),
    (b"II", TiffImageFile),
    (b"MM", TiffImageFile),
    (b"RIFF", WebPImageFile),
    (b"P", PpmImageFile),
    (b"\x00\x00\x00\x0cjP", Jpeg2KImageFile),
    (b"\xff\x4f\xff\x51", Jpeg2KImageFile),
)
"""What reads a header, by the bytes that a file begins with."""
_UPRIGHT = (0, 1)  # Orientations of pictures that are stored as they are shown


class PictureTags(NamedTuple):
    """What the tags of a picture say of it."""

    orientation: int = 1  # how viewers turn it, see `Orientation`
    focal_35mm: float | None = None  # equivalent focal length in mm on film of 36 x 24 mm


def read_picture(path: Path | str) -> Bytes:
    """The BGR pixels (h, w, 3) of a picture file; SessionError if they cannot be read.

    Pixels are taken as the sensor gave them: an orientation tag is not applied, because the camera
    model belongs to the sensor.
    """
    return decode_picture(picture_bytes(Path(path)), str(path))


def picture_bytes(path: Path, where: str = "") -> bytes:
    """The bytes of a picture's file; SessionError, beginning with `where`, if there are none."""
    data = read_bytes(path, SessionError, _MAX_BYTES, where)
    if not data:
        raise SessionError(f"{where}{path}: the file is empty (0 bytes)")
    return data


def refuse_huge(size_wh: tuple[int, int], where: str) -> None:
    """Refuse (SessionError) a picture larger than MEASURE_MAX_MEGAPIXELS, else 100, undecoded."""
    most = most_pixels()
    if size_wh[0] * size_wh[1] > most:
        raise SessionError(
            f"{where}: a picture of {size_wh[0]}x{size_wh[1]} px, larger than "
            f"{most / 1e6:g} megapixels: if it is meant, set {LIMIT} in the environment"
        )


def most_pixels() -> float:
    """Most pixels of a picture that is decoded; SessionError: the environment sets no number."""
    text = os.environ.get(LIMIT, "")
    try:
        given = float(text) if text else _DEFAULT_MEGAPIXELS
    except ValueError:
        given = 0.0
    if not 0 < given < float("inf"):
        raise SessionError(
            f"{LIMIT} is {text!r} in the environment: expected a number of megapixels"
        )
    return given * 1e6


def picture_size_wh(data: bytes) -> tuple[int, int] | None:
    """Width and height in px by a picture's header, or of a TIFF's larger tile; None if unknown."""
    if data.startswith(JPEG_START):
        return jpeg_size_wh(data)
    if (header := _header(data)) is None:
        return None
    tags = getattr(header, "tag_v2", {})
    tile = (int(tags.get(Base.TileWidth, 0)), int(tags.get(Base.TileLength, 0)))
    return max(header.size, tile, key=lambda size: size[0] * size[1])


def is_turned(data: bytes) -> bool:
    """Whether a tag asks viewers to turn or mirror a picture."""
    return picture_tags(data).orientation not in _UPRIGHT


def picture_tags(data: bytes) -> PictureTags:
    """What a picture's Exif tags say, as far as they can be read."""
    try:
        header = _header(data)
        tags = {} if header is None else header.getexif()
        lens = {} if header is None else header.getexif().get_ifd(IFD.Exif)
        focal_mm = float(lens.get(Base.FocalLengthIn35mmFilm, 0))
        return PictureTags(int(tags.get(Base.Orientation, 1)), focal_mm if focal_mm > 0 else None)
    except Exception:  # Pillow raises many kinds; all mean broken tags
        return PictureTags()


def _header(data: bytes) -> ImageFile | None:
    reader = next((kind for start, kind in _READERS if data.startswith(start)), None)
    try:
        return None if reader is None else reader(BytesIO(data))
    except Exception:  # Pillow's readers raise many kinds; all mean the header
        return None


def jpeg_segments(data: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Kind, and place behind its marker, of each segment of a JPEG up to its end, or to a fault.

    Thumbnails within it, and what phones write behind it, have markers of their own.
    """
    at, find = 2, _SEGMENT.search  # Decoders pass over what stands between the first segments
    while segment := find(data, at):
        kind, at = segment[1][0], segment.end()
        yield kind, at
        if kind == JPEG_END[1]:
            return
        at += int.from_bytes(data[at : at + 2], "big")
        if kind == JPEG_SCAN[1]:
            marker, find = _AFTER_SCAN.search(data, at), _SEGMENT.match
            at = marker.start() if marker else len(data)


def jpeg_size_wh(data: bytes) -> tuple[int, int] | None:
    """Width and height in px that the frame header of a JPEG states; None if there is none."""
    for kind, at in jpeg_segments(data):
        if kind in _FRAME_HEADERS and len(data) >= at + 7:
            height, width = data[at + 3 : at + 5], data[at + 5 : at + 7]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        if kind == JPEG_SCAN[1]:
            break
    return None


def is_complete_jpeg(data: bytes | bytearray) -> bool:
    """Whether it is a JPEG that has an end; most have it at the very end, quicker to see."""
    if not data.startswith(JPEG_START):
        return False
    return data.endswith(JPEG_END) or any(kind == JPEG_END[1] for kind, _ in jpeg_segments(data))


def decode_picture(data: bytes, where: str, bits: int | None = None) -> Bytes:
    """BGR pixels (h, w, 3) of an encoded picture.

    How many bits one of 16 really holds is found from its largest value if omitted. SessionError:
    truncated, not a picture, of larger values than `bits` hold, or larger than `refuse_huge` lets
    pass.
    """
    pixels = _decoded(data, where, cv2.IMREAD_COLOR)
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, dtype=np.uint8)
    largest = int(pixels.max(initial=0))
    bits = bits or held_bits(largest)
    if largest >> bits:
        raise SessionError(
            f"{where}: values up to {largest} are more than the {bits} bits of this camera's other "
            f"pictures: say bit_depth = {held_bits(largest)} for it in session.toml"
        )
    return np.asarray(pixels >> (bits - 8), dtype=np.uint8)


def picture_form(data: bytes, where: str) -> tuple[tuple[int, int], int | None]:
    """Size of a picture in px; largest value of 16 bits, None for 8. SessionError if grey."""
    pixels = _decoded(data, where, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        raise SessionError(
            f"{where}: the picture has one channel, but colour distinguishes balls: have the "
            "camera give colour; what a colour sensor gives raw (Bayer) must be demosaiced first"
        )
    largest = None if pixels.dtype == np.uint8 else int(pixels.max(initial=0))
    return (pixels.shape[1], pixels.shape[0]), largest


def held_bits(largest: int) -> int:
    """How many bits a sensor has by the largest value of its pictures, at least 8."""
    return next(bits for bits in (8, 10, 12, 14, 16) if largest >> bits == 0)


_MOST_SCANS = 100  # Of a progressive JPEG: each is a pass over the whole picture
_WINDOW_BYTES, _SEEN_BYTES, _FEW_VALUES = 4096, 256, 100
"""Of compressed data so many bytes of each window are looked at. Those of a picture have about 160
different values; where they have fewer, they may unpack to a thousand times as much."""
_SLACK = 2, 1 << 16  # Times what a PNG's header says, and bytes, that its data may unpack to
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # By the colour type of PNG


def _refuse_endless(data: bytes, size_wh: tuple[int, int], where: str) -> None:
    """Refuse (SessionError) a picture whose data hold far more than its header says, undecoded."""
    if data.startswith(JPEG_START):
        scans = (kind for kind, _ in jpeg_segments(data) if kind == JPEG_SCAN[1])
        is_endless = data.count(JPEG_SCAN) > _MOST_SCANS and len([*scans]) > _MOST_SCANS
    else:
        is_endless = data.startswith(_PNG_START) and _unpacks_further(data, size_wh)
    if is_endless:
        raise SessionError(
            f"{where}: its data ({len(data)} bytes) unpack to far more than the "
            f"{size_wh[0]}x{size_wh[1]} px that its header states; remove the file, and its frame "
            "counts as missing"
        )


def _unpacks_further(png: bytes, size_wh: tuple[int, int]) -> bool:
    """Whether the data of a PNG hold far more than its header says."""
    parts, at = list[memoryview](), len(_PNG_START)
    while at + 8 <= len(png):
        size = int.from_bytes(png[at : at + 4], "big")
        if png[at + 4 : at + 8] == b"IDAT":
            parts.append(memoryview(png)[at + 8 : at + 8 + size])
        at += 12 + size
    packed = b"".join(parts)
    windows = np.frombuffer(packed[: len(packed) // _WINDOW_BYTES * _WINDOW_BYTES], np.uint8)
    seen = np.sort(windows.reshape(-1, _WINDOW_BYTES)[:, :_SEEN_BYTES], axis=1)
    if np.all(np.count_nonzero(np.diff(seen, axis=1), axis=1) > _FEW_VALUES):
        return False
    bits = size_wh[0] * png[24] * _CHANNELS.get(png[25], 4)
    most = _SLACK[0] * size_wh[1] * (1 + bits // 8) + _SLACK[1]
    try:
        return len(zlib.decompressobj().decompress(packed, most)) >= most
    except zlib.error:
        return False  # broken: the decoder says so


def _decoded(data: bytes, where: str, mode: int) -> NDArray[Any]:
    # OpenCV fills the rest of a truncated JPEG with grey and says nothing.
    if data.startswith(JPEG_START) and not is_complete_jpeg(data):
        raise SessionError(
            f"{where}: truncated JPEG ({len(data)} bytes, no end marker); "
            "remove the file, and its frame counts as missing"
        )
    size_wh = picture_size_wh(data)
    pixels = None
    if size_wh is not None:
        refuse_huge(size_wh, where)
        _refuse_endless(data, size_wh, where)
        flags = mode if mode < 0 else mode | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise SessionError(f"{where}: not a picture that can be decoded ({len(data)} bytes)")
    return pixels
