"""Colours of pixels by one table look-up each, and tables for colours that need a second search.

White balls, which hue does not separate from grey, are as dark as grey on their shaded side: a
fixed threshold of brightness cuts such a ball at its shade, and the rest is no circle. They are
searched twice: by their colour, and as brighter than the median grey of the picture.

Balls may stand in front of dull things of their hue: an orange ball and cardboard, a yellow one and
wood. A range of hue that holds a colour in all lights holds much else, to which the ball is joined.
Where what has a colour falls into dull and vivid pixels, the vivid ones are searched once more.

Balls in hard light are cut along their terminator: colour ranges exclude dark pixels, in which grey
may have any hue. They are searched by their colour, and by that together with dark pixels of the
same hue and high saturation.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, lru_cache

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled
from measure.model import BallColor
from measure.model.body import ColorRange

_BITS = 6
_LEVELS = 1 << _BITS
_WIDTH = 256 // _LEVELS
MAX_COLORS = 8
"""The bits of one byte."""
_ONE, _TWO = np.uint64(1), np.uint64(2)
_SIX, _TWELVE = np.uint64(_BITS), np.uint64(2 * _BITS)


@lru_cache(maxsize=16)
def color_table(colors: tuple[BallColor, ...]) -> Bytes:
    """Bit i of entry (b, g, r), each cut to six bits, is set if it matches `colors[i]`.

    Args:
        colors: at most eight.

    Returns:
        (64, 64, 64) bytes; do not change it, it is shared.
    """
    if len(colors) > MAX_COLORS:
        raise ValueError(f"colors: expected at most {MAX_COLORS} different ones, got {len(colors)}")
    samples = np.moveaxis(_entries(), 0, -1).reshape(_LEVELS, -1, 3)
    table = np.zeros(samples.shape[:2], np.uint8)
    for bit, color in enumerate(colors):
        table |= np.where(color.mask(samples) > 0, np.uint8(1 << bit), np.uint8(0))
    table = table.reshape(_LEVELS, _LEVELS, _LEVELS)
    table.setflags(write=False)
    return table


@cache
def _entries() -> Bytes:
    """Blue, green and red (3, 64, 64, 64) in the middle of each entry of a colour table."""
    return np.indices((_LEVELS,) * 3, np.uint8) * np.uint8(_WIDTH) + np.uint8(_WIDTH // 2)


@compiled
def classify(pixels: Bytes, table: Bytes, sparse: Bytes, step: int) -> tuple[Bytes, Bytes]:
    """Colour bits of an image reduced by `step`; of every other pixel each way by another table.

    Each reduced pixel is the mean of four pixels near the middle of its block: enough to tame noise
    and the demosaic's colour fringes, and a quarter of the reading that a full mean takes.

    Args:
        pixels: BGR (h, w, 3).
        table: from `color_table`.
        step: reduction, 1 or more.

    Returns:
        (h // step, w // step) bytes, and those at even rows and columns by the other table.
    """
    height, width = pixels.shape[0] // step, pixels.shape[1] // step
    rows, entries, others = pixels.reshape(len(pixels), -1), table.reshape(-1), sparse.reshape(-1)
    first = max(step // 2 - 1, 0)
    second = min(first + 1, step - 1)
    apart = 3 * (second - first)
    out = np.empty((height, width), np.uint8)
    some = np.empty((-(-height // 2), -(-width // 2)), np.uint8)
    cut, places = np.empty(rows.shape[1], np.uint8), np.empty(width, np.uint32)
    for i in range(height):
        above, below = rows[i * step + first], rows[i * step + second]
        above_right, below_right = above[apart:], below[apart:]
        for k in range(len(above_right)):  # also where they are not needed: vectorised
            cut[k] = (above[k] + below[k] + above_right[k] + below_right[k]) >> 4
        for j in range(width):
            # Unsigned indices: no check for negative ones.
            at = np.uint64(3 * (j * step + first))
            blue, green, red = cut[at], cut[at + _ONE], cut[at + _TWO]
            places[j] = (np.uint64(blue) << _TWELVE) | (np.uint64(green) << _SIX) | np.uint64(red)
            out[i, j] = entries[places[j]]
        if i % 2 == 0:
            for j in range(0, width, 2):
                some[i // 2, j // 2] = others[places[j]]
    return out, some


_GREY_STRIDE = 32  # Stride of the rows and columns from which the picture's grey is taken
_BRIGHTER = 1.35  # Threshold of brightness per median grey, in picture values
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
        pixels: BGR (h, w, 3).

    Returns:
        (64, 64, 64).
    """
    pale = _of_any_value(color, bit)
    some = pixels[_GREY_STRIDE // 2 :: _GREY_STRIDE, _GREY_STRIDE // 2 :: _GREY_STRIDE]
    values = some[pale[tuple(np.moveaxis(some // _WIDTH, -1, 0))] > 0].max(axis=1)
    level = float(np.median(values)) if len(values) else 0.0
    bright = _entries().max(axis=0) >= np.uint8(min(_BRIGHTER * level, 255.0))
    return np.multiply(pale, bright, dtype=np.uint8)


@cache
def _of_any_value(color: BallColor, bit: int) -> Bytes:
    floorless = replace(color, ranges=tuple(replace(r, low=(*r.low[:2], 0)) for r in color.ranges))
    return color_table((floorless,)) * np.uint8(bit)


_STRIDE = 2  # Stride of the reduced pixels that are counted
_MIN_PIXELS, _MIN_DULL = 30, 0.4
"""Fewest pixels of a colour that are split, and the least share of dull ones."""
_TIMES_AS_VIVID = 2.0  # Least ratio of the mean chroma of vivid pixels to that of dull ones


def more_vivid_than_the_rest(
    pixels: Bytes, table: Bytes, step: int, count: int
) -> list[tuple[int, Bytes]]:
    """Colours whose dull and vivid pixels are far apart, each with a table of the vivid ones.

    They are split at the chroma, the greatest minus the least of blue, green and red, that makes
    the variance between both largest (Otsu 1979).

    Args:
        pixels: BGR (h, w, 3).
        table: from `color_table`.
        step: reduction, see `classify`.

    Returns:
        Numbers of colours; (64, 64, 64) with 1 where a vivid pixel is.
    """
    out = []
    for i, histogram in enumerate(_chroma_histograms(pixels, table, _STRIDE * step, count)):
        least = _split(histogram.astype(np.float64))
        if least is not None:
            vivid = np.ptp(_entries(), axis=0) >= np.uint8(_WIDTH * least)
            out.append((i, np.multiply(table >> np.uint8(i) & np.uint8(1), vivid, dtype=np.uint8)))
    return out


def _chroma_histograms(pixels: Bytes, table: Bytes, stride: int, count: int) -> Ints:
    """How many of some pixels have each colour (count, 64) with each chroma, in levels."""
    some = pixels[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3) >> (8 - _BITS)
    blue, green, red = some.T
    bits = table[blue, green, red]
    chroma = np.maximum(np.maximum(blue, green), red) - np.minimum(np.minimum(blue, green), red)
    has = (bits >> np.uint8(i) & np.uint8(1) > 0 for i in range(count))
    out = [np.bincount(chroma[one], minlength=_LEVELS) for one in has]
    return np.array(out, np.int64).reshape(count, _LEVELS)


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


def much_in_shade(lit: Bytes, shaded: Bytes, bit: int) -> bool:
    """Whether so much of a colour, by lit and shaded pixels (h, w), is in shade as to cut balls."""
    dark, light = (np.count_nonzero(bits & np.uint8(bit)) for bits in (shaded, lit))
    return bool(dark > (1 + _MUCH_SHADE) * light)


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
