"""Balls in front of dull things of their hue: an orange ball and cardboard, a yellow one and wood.

A range of hue that holds a colour in all lights holds much else, to which the ball is joined. Where
what has a colour falls into dull and vivid pixels, the vivid ones are searched once more.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled

_STRIDE = 2
"""Stride of the reduced pixels that are counted."""
_MIN_PIXELS, _MIN_DULL = 30, 0.4
"""Fewest pixels of a colour that are split, and the least share of dull ones."""
_TIMES_AS_VIVID = 2.0
"""Least ratio of the mean chroma of vivid pixels to that of dull ones."""
_LEVELS = 64


def more_vivid_than_the_rest(
    pixels: Bytes, table: Bytes, step: int, count: int
) -> list[tuple[int, Bytes]]:
    """Colours of which dull and vivid pixels are far apart, each with a table of the vivid ones.

    They are split at the chroma, the greatest minus the least of blue, green and red, that makes
    the variance between both largest (Otsu 1979).

    Args:
        pixels: BGR (h, w, 3).
        table: from `color_table`.
        step: reduction, see `classify`.
        count: of colours in the table.

    Returns:
        Numbers of colours; (64, 64, 64) with 1 where a vivid pixel is.
    """
    out = []
    for i, histogram in enumerate(_chroma_histograms(pixels, table, _STRIDE * step, count)):
        least = _split(histogram.astype(np.float64))
        if least is not None:
            vivid = _chroma() >= np.uint8(least)
            out.append((i, np.multiply(table >> np.uint8(i) & np.uint8(1), vivid, dtype=np.uint8)))
    return out


@compiled
def _chroma_histograms(pixels: Bytes, table: Bytes, stride: int, count: int) -> Ints:
    """How many of some pixels have each colour (count, 64) with each chroma, in levels."""
    out, one = np.zeros((count, _LEVELS), np.int64), np.uint8(1)
    for i in range(stride // 2, pixels.shape[0], stride):
        for j in range(stride // 2, pixels.shape[1], stride):
            b, g, r = pixels[i, j, 0] >> 2, pixels[i, j, 1] >> 2, pixels[i, j, 2] >> 2
            bits = table[b, g, r]
            for k in range(count):
                if bits >> np.uint8(k) & one:
                    out[k, max(b, g, r) - min(b, g, r)] += 1
    return out


def _split(histogram: Floats) -> int | None:
    """The least chroma of vivid pixels; None if they are not far from the dull ones."""
    total, chroma = histogram.sum(), np.arange(_LEVELS)
    if total < _MIN_PIXELS:
        return None
    below, moment = np.cumsum(histogram)[:-1], np.cumsum(histogram * chroma)
    above, rest = total - below, moment[-1] - moment[:-1]
    some = (below > 0) & (above > 0)
    dull, vivid = moment[:-1] / np.maximum(below, 1), rest / np.maximum(above, 1)
    if not some.any():
        return None
    at = int(np.argmax(np.where(some, below * above * (vivid - dull) ** 2, -1.0)))
    far = below[at] >= _MIN_DULL * total and vivid[at] >= _TIMES_AS_VIVID * dull[at]
    return at + 1 if far else None


@cache
def _chroma() -> Bytes:
    """The greatest minus the least of blue, green and red for each entry of a colour table."""
    blue, green, red = np.ogrid[:_LEVELS, :_LEVELS, :_LEVELS]
    greatest = np.maximum(np.maximum(blue, green), red)
    return (greatest - np.minimum(np.minimum(blue, green), red)).astype(np.uint8)
