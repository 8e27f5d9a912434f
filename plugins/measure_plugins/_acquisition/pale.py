"""White balls, which hue does not separate from grey, and whose shaded side is as dark as grey.

A fixed threshold of brightness cuts such a ball at its shade, and the rest is no circle. They are
searched twice: by their colour, and as brighter than the median grey of the picture.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from measure.arrays import Bytes
from measure.model import BallColor
from measure.model.color import ColorRange
from measure_plugins._acquisition.color_table import color_table

_GREY_STRIDE = 32
"""Stride of the rows and columns from which the picture's grey is taken."""
_BRIGHTER = 1.35
"""Threshold of brightness per median grey, in picture values."""
_ALL_HUES = (0, 179)


def is_pale(color: BallColor) -> bool:
    """Whether a colour is any hue with little saturation and no upper end: white, light grey."""
    return any(
        r.space == "hsv"
        and (r.low[0], r.high[0]) == _ALL_HUES
        and r.low[1] == 0
        and r.high[1] < 255
        and r.high[2] == 255
        for r in color.ranges
    )


def brighter_than_the_rest(color: BallColor, bit: int, pixels: Bytes) -> Bytes:
    """A `color_table` of pale colours that are brighter than the median grey of a picture.

    Args:
        color: a colour that `is_pale`.
        bit: to be set in the table.
        pixels: BGR (h, w, 3).

    Returns:
        (64, 64, 64).
    """
    pale = _of_any_value(color, bit)
    some = pixels[_GREY_STRIDE // 2 :: _GREY_STRIDE, _GREY_STRIDE // 2 :: _GREY_STRIDE].reshape(
        -1, 3
    )
    cut = some // (256 // len(pale))
    values = some[pale[cut[:, 0], cut[:, 1], cut[:, 2]] > 0].max(axis=1)
    level = float(np.median(values)) if len(values) else 0.0
    bright = _values(len(pale)) >= np.uint8(min(_BRIGHTER * level, 255.0))
    return np.multiply(pale, bright, dtype=np.uint8)


@cache
def _of_any_value(color: BallColor, bit: int) -> Bytes:
    floorless = replace(color, ranges=tuple(map(_without_floor, color.ranges)))
    return color_table((floorless,)) * np.uint8(bit)


def _without_floor(known: ColorRange) -> ColorRange:
    return replace(known, low=(*known.low[:2], 0))


@cache
def _values(levels: int) -> Bytes:
    """The greatest of blue, green and red for each entry of a colour table."""
    level = np.arange(levels) * (256 // levels) + 128 // levels
    blue, green, red = np.meshgrid(level, level, level, indexing="ij")
    return np.maximum(np.maximum(blue, green), red).astype(np.uint8)
