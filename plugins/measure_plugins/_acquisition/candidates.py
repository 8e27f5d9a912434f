"""Candidates of the balls in one picture: circles of their colours, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats
from measure.model import BallColor
from measure_plugins._acquisition.circles import circles_of, distinct
from measure_plugins._acquisition.color_table import (
    MAX_COLORS,
    brighter_than_the_rest,
    classify,
    color_table,
    is_pale,
    more_vivid_than_the_rest,
    much_in_shade,
    with_shade,
)
from measure_plugins._acquisition.patches import majority
from measure_plugins._acquisition.small import MIN_RADIUS_PX, find_small_circles

_REDUCED_WIDTH = 320
_MIN_RADIUS, _MAX_RADIUS_SHARE = 2.5, 0.35
"""Smallest radius searched for in the reduced picture, in its pixels, and the largest, as a share
of the picture's height."""
_MIN_SEEN, _MIN_FILLED = 0.16, 0.3
"""Least share of a ball's outline in sight, and of a circle's inside that has the ball's colour."""
_MAX_CANDIDATES = 10  # Per ball and picture


class FoundCircles(NamedTuple):
    """Circles of each colour in one picture."""

    # for each colour up to ten circles (k, 6), best first, to a pixel or two: centre
    # x, y and radius in px, share of the circle seen, share of its inside that has the colour, and
    # the number of the bit in `table` that has found it.
    of_color: list[Floats]
    # (64, 64, 64) bits of the colours, with their shade, and then of those that were searched once
    # more.
    table: Bytes


def find_circles(pixels: Bytes, colors: Sequence[BallColor]) -> FoundCircles:
    """Search one whole picture for balls of some colours.

    Which candidates are balls, and which ball, is decided by geometry later.

    Args:
        pixels: BGR (h, w, 3), contiguous.
    """
    step, count = max(1, round(pixels.shape[1] / _REDUCED_WIDTH)), len(colors)
    table, with_dark, pale = _tables(tuple(colors))
    again = [(i, brighter_than_the_rest(colors[i], 1, pixels)) for i in pale]
    again += more_vivid_than_the_rest(pixels, table, step, count)
    again = again[: MAX_COLORS - count]
    for bit, (_, some) in enumerate(again, count):
        table, with_dark = table | some << np.uint8(bit), with_dark | some << np.uint8(bit)
    # As those of the cache are: else the loops would be compiled once more.
    table.setflags(write=False)
    with_dark.setflags(write=False)
    bits, dark = _bits_of(pixels, table, with_dark, step, count)
    found = _circles(bits, range(count + len(again)), step, pixels.shape[0])
    owners = [*range(count), *(i for i, _ in again)]
    more = list(zip(owners[count:], found[count:], strict=True))
    if dark:
        bits, _ = _bits_of(pixels, with_dark, with_dark, step, 0)
        more += zip(dark, _circles(bits, dark, step, pixels.shape[0]), strict=True)
        chosen = np.uint8(sum(1 << i for i in dark))
        table = (table & ~chosen) | (with_dark & chosen)
        table.setflags(write=False)
    small = find_small_circles(pixels, table, range(len(owners)), step, _MAX_CANDIDATES)
    more += zip(owners, small, strict=True)
    for i, others in (one for one in more if len(one[1])):
        found[i] = distinct(np.concatenate([found[i], others]))[:_MAX_CANDIDATES]
    return FoundCircles(found[:count], with_dark)


def _bits_of(
    pixels: Bytes, table: Bytes, with_dark: Bytes, step: int, count: int
) -> tuple[Bytes, list[int]]:
    """Colour bits of the reduced picture, see `classify`, and which colours are in shade too."""
    every, some = classify(pixels, table, with_dark, step)
    bits, dark = majority(every), majority(some)
    lit = bits[::2, ::2]
    return bits, [i for i in range(count) if much_in_shade(lit, dark, 1 << i)]


@lru_cache(maxsize=16)
def _tables(colors: tuple[BallColor, ...]) -> tuple[Bytes, Bytes, tuple[int, ...]]:
    """The table of colours, the one that includes shade, and which of them are pale."""
    pale = [i for i, color in enumerate(colors) if is_pale(color)]
    return color_table(colors), with_shade(colors), tuple(pale)


def warm_up() -> None:
    """Compile the loops, or load them from the cache, before the first picture arrives."""
    table = color_table((BallColor.named("red"),))
    bits, _ = _bits_of(np.zeros((64, 64, 3), np.uint8), table, table, 4, 1)
    bits[5:12, 5:12] = 1
    distinct(_circles(bits, [0], 4, 64)[0])


def _circles(bits: Bytes, of: Sequence[int], step: int, height: int) -> list[Floats]:
    """Circles (k, 6) of some colours, best first, see `FoundCircles`."""
    radii = (max(MIN_RADIUS_PX / step, _MIN_RADIUS), _MAX_RADIUS_SHARE * height / step)
    out = []
    for bit in of:
        circles = circles_of(bits, 1 << bit, radii, _MIN_SEEN, _MIN_FILLED, _MAX_CANDIDATES)
        circles[:, :3] *= step
        circles[:, :2] += (step - 1) / 2
        out.append(np.column_stack([circles, np.full(len(circles), bit)]))
    return out
