"""Pixels of ROS's `sensor_msgs/Image`, as cameras' drivers encode them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from measure.arrays import Bytes
from measure.errors import SessionError
from measure.session.pictures import refuse_huge


@dataclass(frozen=True)
class Encoding:
    """How `sensor_msgs/Image` keeps pixels of 8 bits."""

    channels: int
    to_bgr: Callable[[Bytes], Any]  # of pixels (h, w, channels)


def _converted(code: int) -> Callable[[Bytes], Any]:
    return lambda pixels: cv2.cvtColor(pixels, code)


def _from_yuyv(pixels: Bytes) -> Any:
    """Colour between its samples, two columns apart, is interpolated, as of videos."""
    import av

    from measure.session.video_file import interpolation

    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="yuyv422")
    return frame.to_ndarray(format="bgr24", interpolation=interpolation())


def _from_uyvy(pixels: Bytes) -> Any:
    return _from_yuyv(pixels[..., ::-1])


_BGR = Encoding(3, lambda pixels: pixels)
GREY = Encoding(1, _converted(cv2.COLOR_GRAY2BGR))
_BGRA = Encoding(4, _converted(cv2.COLOR_BGRA2BGR))
_UYVY, _YUYV = Encoding(2, _from_uyvy), Encoding(2, _from_yuyv)
_ENCODINGS = {
    "bgr8": _BGR,
    "rgb8": Encoding(3, _converted(cv2.COLOR_RGB2BGR)),
    "bgra8": _BGRA,
    "rgba8": Encoding(4, _converted(cv2.COLOR_RGBA2BGR)),
    "mono8": GREY,
    "8UC1": GREY,
    "8UC3": _BGR,
    "8UC4": _BGRA,
    # OpenCV names a mosaic by its second row; these are its names by the first, as ROS has them.
    "bayer_rggb8": Encoding(1, _converted(cv2.COLOR_BayerRGGB2BGR)),
    "bayer_bggr8": Encoding(1, _converted(cv2.COLOR_BayerBGGR2BGR)),
    "bayer_gbrg8": Encoding(1, _converted(cv2.COLOR_BayerGBRG2BGR)),
    "bayer_grbg8": Encoding(1, _converted(cv2.COLOR_BayerGRBG2BGR)),
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
}


def encoding_of(message: Any, where: str) -> Encoding:
    """How an image is encoded; SessionError, from `where` on, if in a way that is not read."""
    known = _ENCODINGS.get(str(message.encoding))
    if known is None:
        raise SessionError(
            f"{where}: pictures are encoded as '{message.encoding}', which is not read; "
            f"{', '.join(_ENCODINGS)} are"
        )
    return known


def raw_pixels(message: Any, where: str) -> Bytes:
    """BGR pixels (h, w, 3) of a `sensor_msgs/Image`; rows may be longer than what they hold."""
    encoding = encoding_of(message, where)
    height, width, step = int(message.height), int(message.width), int(message.step)
    refuse_huge((width, height), where)
    row_bytes, data = width * encoding.channels, np.asarray(message.data, dtype=np.uint8)
    step = step or row_bytes
    if not (width and height) or step < row_bytes or data.size < step * (height - 1) + row_bytes:
        raise SessionError(
            f"{where}: {data.size} bytes of rows of {step}, expected {width}x{height} pixels of "
            f"{message.encoding}"
        )
    padded = np.zeros(step * height, np.uint8)
    padded[: min(data.size, padded.size)] = data[: padded.size]
    rows = padded.reshape(height, step)[:, :row_bytes]
    shape = (height, width) if encoding.channels == 1 else (height, width, encoding.channels)
    return np.asarray(encoding.to_bgr(np.ascontiguousarray(rows).reshape(shape)), dtype=np.uint8)
