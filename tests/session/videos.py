"""Small videos whose grey level tells which frame it is."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

SIZE_WH = (64, 48)
TIME_BASE = Fraction(1, 90000)


def level(frame: int) -> int:
    return 10 * frame + 5


def write_video(
    path: Path,
    codec: str,
    ticks: list[int] | None = None,
    frames: int = 24,
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    shows: list[int] | None = None,
    rotation: float | None = None,
) -> None:
    """Frame k has the grey `level(k)`, or `level(shows[k])`; a tag may ask to turn it, deg.

    `ticks` are its times in 1/90000 s, else 30 a second.
    """
    count = frames if ticks is None else len(ticks)
    shows = list(range(count)) if shows is None else shows
    with av.open(str(path), "w", options=container or {}) as out:
        stream = out.add_stream(codec, rate=30, options=options or {})
        stream.width, stream.height = SIZE_WH
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if rotation is not None:
            stream.set_display_rotation(rotation)
        if ticks is not None:
            stream.time_base = stream.codec_context.time_base = TIME_BASE
        for k in range(count):
            pixels = np.full((SIZE_WH[1], SIZE_WH[0], 3), level(shows[k]), np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
            if ticks is not None:
                frame.pts, frame.time_base = ticks[k], TIME_BASE
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
