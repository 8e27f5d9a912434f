"""White balls: no hue tells them from grey, and their shaded side is as dark as what is round them.

A threshold that holds for every picture cuts such a ball where its shade begins, and the rest is no
circle. So they are searched for twice: by their colour, and by being brighter than the picture's
own grey. What of that is a ball is for geometry to say.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from measure.arrays import Bytes
from measure.model import BallColor
from measure.model.color import ColorRange
from measure_plugins._acquisition.color_table import color_table

_EVERY = 32
"""Rows and columns that tell the picture's grey: one in so many."""
_BRIGHTER = 1.35
"""The outline's shaded side, as a share of what is behind it, in picture values."""
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
    """A `color_table` of what is pale and brighter than most of a picture's grey.

    Args:
        color: a colour that `is_pale`.
        bit: to be set in the table.
        pixels: BGR (h, w, 3).

    Returns:
        (64, 64, 64).
    """
    pale = _of_any_value(color, bit)
    some = pixels[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY].reshape(-1, 3)
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
