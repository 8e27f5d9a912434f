"""Balls in hard light: their shaded side has the ball's hue, but little light.

Colour ranges exclude dark pixels, in which grey may have any hue; a ball lit from one side is cut
along its terminator. Coloured balls are searched twice: by their colour, and by that together with
dark pixels of the same hue and high saturation.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from measure.arrays import Bytes
from measure.compiling import compiled
from measure.model import BallColor
from measure.model.color import ColorRange
from measure_plugins._acquisition.color_table import color_table

_MIN_VALUE = 12  # Least value of a dark pixel, above the quantisation of hue
_MIN_SATURATION = 110
"""Least saturation of a dark pixel: its hue then rests on five levels in the darkest and on a dozen
in less dark ones. Grey pixels a few levels off would pass the lower limits of some colours."""
_MUCH_SHADE = 0.25
"""Pixels in shade, per pixels in light, above which a picture is searched once more: with fewer,
enough
of the outline is visible."""


@lru_cache(maxsize=16)
def with_shade(colors: tuple[BallColor, ...]) -> Bytes:
    """The `color_table` of colours and, where they have a hue, of their shade."""
    return color_table(tuple(map(_reaching, colors)))


@compiled
def much_in_shade(lit: Bytes, shaded: Bytes, bit: int) -> bool:
    """Whether so much of a colour, by lit and shaded pixels (h, w), is in shade as to cut balls."""
    return _count(shaded, bit) > (1 + _MUCH_SHADE) * _count(lit, bit)


@compiled
def _count(bits: Bytes, bit: int) -> int:
    one, count = np.uint8(bit), 0
    for row in bits:
        for value in row:
            count += int(np.uint8(value & one) == one)
    return count


def _reaching(color: BallColor) -> BallColor:
    shaded = [_dark(known) for known in color.ranges if _has_hue(known)]
    return replace(color, ranges=(*color.ranges, *shaded))


def _has_hue(known: ColorRange) -> bool:
    narrow = (known.high[0] - known.low[0]) % 180 < 90
    return known.space == "hsv" and known.low[1] > 0 and narrow


def _dark(known: ColorRange) -> ColorRange:
    hue, saturation, value = known.low
    low = (hue, max(saturation, _MIN_SATURATION), min(value, _MIN_VALUE))
    return replace(known, low=low)
