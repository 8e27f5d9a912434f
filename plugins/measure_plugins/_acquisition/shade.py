"""Balls in the dark: the side that a lone hard lamp leaves unlit has the ball's hue, but no light.

Ranges of colours leave the dark out, where grey things look like any colour. A ball lit from one
side is cut along its terminator by that, and its other side is nowhere. So coloured balls are
searched for twice: by their colour, and by that together with dark pixels of the same hue whose
saturation leaves no doubt that they have one. What of that is a ball is for geometry to say.
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

_LEAST_VALUE = 12
"""Below, the levels of a picture are too few to tell a hue."""
_LEAST_SATURATION = 110
"""Grey in the dark, off by a few levels in one channel, is as saturated as some colours' range
begins; with this, a hue rests on five levels in the darkest and on a dozen in what is less dark."""
_MUCH = 0.25
"""As a share of what is lit. Of a ball with less of it in the dark, enough is seen of its outline;
and other pictures need not be searched once more."""


@lru_cache(maxsize=16)
def with_shade(colors: tuple[BallColor, ...]) -> Bytes:
    """The `color_table` of colours that reach into the dark where they have a hue."""
    return color_table(tuple(map(_reaching, colors)))


@compiled
def much_in_shade(lit: Bytes, shaded: Bytes, bit: int) -> bool:
    """Whether so much of a colour lies in the dark that a ball may be cut or missed without that.

    Args:
        lit: (h, w) colours of some pixels.
        shaded: (h, w) of as many, where colours reach into the dark.
        bit: the colour's.
    """
    return _count(shaded, bit) > (1 + _MUCH) * _count(lit, bit)


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
    low = (hue, max(saturation, _LEAST_SATURATION), min(value, _LEAST_VALUE))
    return replace(known, low=low)
