"""Candidates of the balls in one picture: circles of their colours, the best first.

A picture of any size is reduced to a few hundred pixels across before circles are looked for, so
that small balls of a large picture are lost. A lattice of its pixels, some of them on every
ball, shows where small patches of a colour are. These are cut out, reduced to like sizes, laid side
by side, and searched as one picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.model import BallColor
from measure_plugins._acquisition.circles import borders, circles_of, distinct, framed, majority
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

MIN_RADIUS_PX = 6.0
"""Smallest outline radius searched for: rough circles of balls of 7 px are up to 1 px smaller."""
_LATTICE_PX = 6
"""Distance of the pixels looked at: four or more of them lie on any disc of 7 px radius."""
_MIN_PIXELS = 4  # Fewest pixels of a patch in the lattice
_MIN_FULL, _MIN_ASPECT = 0.5, 0.4
"""Least share of a patch's bounding box that it fills, and of the box's longer side that is its
shorter one: a disc fills 0.79, and so does one that is half hidden."""
_LARGEST = 24
"""Largest patch, in pixels of the reduced picture: there, whole balls are found from a diameter of
7 on, and half hidden ones from 20 on."""
_MOST_PATCHES = 64  # Of a colour, the largest ones: more are noise, or texture
_STEP = 2  # By how much what is laid side by side is reduced
_PATCH, _MARGIN = 36, 5
"""Largest side of a patch then, and how much is cut out round it, by which circles are judged."""
_SIDE_PX = _STEP * (_PATCH + 2 * _MARGIN)
_MIN_SMALL_SEEN, _MIN_SMALL_FILLED = 0.4, 0.4
"""Least share of a circle in sight, and of its inside that has the colour: of half a ball."""
_BESIDE = 0.5  # How far outside of its patch a circle's centre may be, in radii: hidden balls


_NOTHING = np.empty((0, 0), np.uint8)


class _Patches(NamedTuple):
    """Small patches of a colour."""

    low: Ints  # (n, 2) first pixel x, y of each
    high: Ints  # (n, 2) last pixel
    scale: Ints  # (n,) by how much each is reduced before it is laid beside others, a power of two


def find_small_circles(
    pixels: Bytes, table: Bytes, bits: Sequence[int], step: int, most: int
) -> list[Floats]:
    """Circles of some colours that are too small for the picture reduced by `step`, best first.

    Args:
        pixels: BGR (h, w, 3), contiguous.
        table: of colours, see `color_table`.
        bits: their numbers in it.
        step: reduction, see `classify`.
        most: circles of each.

    Returns:
        (k, 6) for each, see `FoundCircles`.
    """
    grid = classify(pixels, table, table, _LATTICE_PX)[0] if step > _STEP else _NOTHING
    patches = [_small_patches(grid, bit, _LARGEST * step) for bit in bits]
    count = sum(len(some.low) for some in patches)
    if count == 0:
        return [np.empty((0, 6)) for _ in bits]
    columns = round(count**0.5)
    rows = np.cumsum([0, *(-(-len(some.low) // columns) for some in patches)])
    sheet = np.zeros((_SIDE_PX * int(rows[-1]), _SIDE_PX * columns, 3), np.uint8)
    for some, row in zip(patches, rows.tolist(), strict=False):
        _lay_side_by_side(pixels, some, sheet[_SIDE_PX * row :], columns)
    seen, _ = classify(sheet, table, table, _STEP)
    seen, per_row = majority(seen), _SIDE_PX // _STEP
    return [
        _circles_in(seen[per_row * first : per_row * last], bit, some, columns, most)
        for bit, some, (first, last) in zip(bits, patches, pairwise(rows.tolist()), strict=True)
    ]


def _small_patches(grid: Bytes, bit: int, largest_px: int) -> _Patches:
    """Patches of a colour in a lattice of pixels that may be balls no larger than that."""
    none = np.empty((0, 2), np.int64)
    used = np.nonzero((grid & np.uint8(1 << bit)).any(axis=1))[0]
    if len(used) == 0:
        return _Patches(none, none, none[:, 0])
    first = int(used[0])
    outer = borders(framed(grid[first : used[-1] + 1], 1 << bit), _MIN_PIXELS)
    if not outer:
        return _Patches(none, none, none[:, 0])
    at, ends = np.concatenate(outer), np.cumsum([len(one) for one in outer])
    starts = np.concatenate([[0], ends[:-1]])
    low, high = np.minimum.reduceat(at, starts), np.maximum.reduceat(at, starts)
    (width, height), area = (high - low + 1).T, _areas(at, starts, ends)
    longer, shorter = np.maximum(width, height), np.minimum(width, height)
    small = (_LATTICE_PX * longer <= largest_px) & (area >= _MIN_PIXELS)
    small &= (area >= _MIN_FULL * longer * shorter) & (shorter >= _MIN_ASPECT * longer)
    which = np.nonzero(small)[0]
    which = which[np.argsort(-area[which], kind="stable")][:_MOST_PATCHES]
    octave = np.ceil(np.log2(np.maximum(_LATTICE_PX * longer[which] / (_STEP * _PATCH), 1.0)))
    down = np.array([0, first])
    low, high = _LATTICE_PX * (low[which] + down), _LATTICE_PX * (high[which] + down + 1) - 1
    return _Patches(low, high, 1 << octave.astype(np.int64))


def _areas(at: Ints, starts: Ints, ends: Ints) -> Floats:
    """Pixels (n,) inside borders, and on them, by Pick's theorem; holes count."""
    after = np.arange(1, len(at) + 1)
    after[ends - 1] = starts
    twice = np.add.reduceat(at[:, 0] * at[after, 1] - at[after, 0] * at[:, 1], starts)
    return np.asarray((np.abs(twice) + ends - starts) / 2 + 1)


def _origins(patches: _Patches) -> Ints:
    """The first pixel (n, 2) of the square about each patch that is cut out."""
    return (patches.low + patches.high + 1 - _SIDE_PX * patches.scale[:, None]) // 2


def _lay_side_by_side(pixels: Bytes, patches: _Patches, sheet: Bytes, columns: int) -> None:
    """Fill squares of a sheet, row by row, with the surroundings of patches."""
    origins, scales = _origins(patches).tolist(), patches.scale.tolist()
    for k, ((x, y), scale) in enumerate(zip(origins, scales, strict=True)):
        left, top = max(x, 0), max(y, 0)
        some = pixels[top : y + _SIDE_PX * scale, left : x + _SIDE_PX * scale]
        height, width = -(-some.shape[0] // scale), -(-some.shape[1] // scale)
        u = k % columns * _SIDE_PX + (left - x) // scale
        v = k // columns * _SIDE_PX + (top - y) // scale
        sheet[v : v + height, u : u + width] = (
            cv2.resize(some, (width, height), interpolation=cv2.INTER_AREA) if scale > 1 else some
        )


def _circles_in(seen: Bytes, bit: int, patches: _Patches, columns: int, most: int) -> Floats:
    """Circles (k, 6) of a colour in patches that are laid side by side and reduced."""
    if len(seen) == 0:
        return np.empty((0, 6))
    radii = (MIN_RADIUS_PX / _STEP, float(_PATCH))
    circles = circles_of(seen, 1 << bit, radii, _MIN_SMALL_SEEN, _MIN_SMALL_FILLED, most)
    cell = _SIDE_PX // _STEP
    column, row = np.maximum(circles[:, :2] // cell, 0).astype(np.int64).T
    number = np.minimum(row * columns + np.minimum(column, columns - 1), len(patches.low) - 1)
    scale = patches.scale[number, None]
    circles[:, :2] -= cell * np.column_stack([column, row])
    circles[:, :3] *= _STEP * scale
    circles[:, :2] += _origins(patches)[number] + (_STEP * scale - 1) / 2
    beside = np.maximum(patches.low[number] - circles[:, :2], circles[:, :2] - patches.high[number])
    own = circles[beside.max(axis=1) <= _BESIDE * circles[:, 2]]
    return np.column_stack([own, np.full(len(own), bit)])


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
