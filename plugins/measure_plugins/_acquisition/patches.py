"""Patches of one colour in a reduced picture: the speckle taken off, and the border of each."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Ints
from measure.compiling import compiled

_DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])
_DY = np.array([0, -1, -1, -1, 0, 1, 1, 1])
"""The eight neighbours of a pixel, counter-clockwise from the right as one looks at the picture."""
_WEST = 4
_CHUNK = 32
"""Pixels that are looked at together, to skip what has no colour at all."""
_SET, _ENTERED, _LEFT = 1, 2, 3
"""Labels: a pixel of the colour; one on a traced border; the same, with nothing to its right."""


@compiled
def majority(bits: Bytes) -> Bytes:
    """Each bit as most of the 3 x 3 pixels about it have it: a median filter of every colour.

    The nine pixels are counted bit by bit, with the adders that hardware uses, so that all colours
    are counted at once. Pixels at the picture's border count their neighbours there twice.

    Args:
        bits: (h, w) colours of each pixel.
    """
    h, w = bits.shape
    ones, twos = np.empty((h, w), np.uint8), np.empty((h, w), np.uint8)
    for i in range(h):
        row, one, two = bits[i], ones[i], twos[i]
        for j in range(1, w - 1):
            a, b, c = row[j - 1], row[j], row[j + 1]
            one[j], two[j] = a ^ b ^ c, (a & b) | (c & (a | b))
        for j, side in ((0, min(1, w - 1)), (w - 1, max(w - 2, 0))):
            one[j], two[j] = row[side], row[j]
    out = np.empty((h, w), np.uint8)
    for i in range(h):
        above, below = max(i - 1, 0), min(i + 1, h - 1)
        for j in range(w):
            a, b, c = ones[above, j], ones[i, j], ones[below, j]
            one, p = a ^ b ^ c, (a & b) | (c & (a | b))
            q, r, s = twos[above, j], twos[i, j], twos[below, j]
            two, four = p ^ q ^ r ^ s, (p & q) | (r & s) | ((p | q) & (r | s))
            eight = p & q & r & s
            out[i, j] = eight | (four & (two | one))
    return out


@compiled
def borders(bits: Bytes, bit: int, least: int) -> tuple[Ints, Ints]:
    """Outer borders of a colour's patches, each in order (Suzuki and Abe 1985, algorithm 2).

    Args:
        bits: (h, w) colours of each pixel.
        bit: the colour's.
        least: borders with fewer pixels are left out.

    Returns:
        (n, 2) pixels x, y of one border after the other; (patches,) the row after each one's last.
    """
    labels, filled = _labels(bits, bit)
    h, w = bits.shape
    pixels = np.empty((4 * filled, 2), np.int64)  # a border passes a pixel four times at most
    ends = np.empty(filled, np.int64)
    count, total = 0, 0
    for i in range(1, h + 1):
        row = labels[i]
        if not _any(row):
            continue
        inside = False
        for start in range(1, w + 1, _CHUNK):
            stop = min(start + _CHUNK, w + 1)
            if not _any(row[start:stop]):
                continue
            for j in range(start, stop):
                label = row[j]
                if label == _SET and row[j - 1] == 0 and not inside:
                    end = _trace(labels, i, j, pixels, total)
                    label = row[j]
                    if end - total >= least:
                        ends[count] = total = end
                        count += 1
                if label > _SET:
                    inside = label == _ENTERED
    return pixels[:total], ends[:count]


@compiled
def _labels(bits: Bytes, bit: int) -> tuple[Bytes, int]:
    """_SET where pixels have the colour, in a margin of zeros; and how many have it."""
    h, w = bits.shape
    out = np.zeros((h + 2, w + 2), np.uint8)
    count = 0
    for i in range(h):
        colors, row = bits[i], out[i + 1, 1 : w + 1]
        for j in range(w):
            row[j] = np.uint8((colors[j] & bit) != 0)
        for j in range(w):
            count += row[j]
    return out, count


@compiled
def _any(row: Bytes) -> bool:
    some = np.uint8(0)
    for value in row:
        some = np.uint8(some | value)
    return some != 0


@compiled
def _trace(labels: Bytes, row: int, column: int, pixels: Ints, at: int) -> int:
    """Follow an outer border from its first pixel, label it, and write it down from row `at` on.

    Args:
        labels: (h + 2, w + 2), a margin of zeros about the picture; changed in place.
        row: of the first pixel, in `labels`.
        column: the same; the pixel to its left has not the colour.
        pixels: (room, 2) where x, y in the picture are written.
        at: first free row of `pixels`.

    Returns:
        The first row that is free now.
    """
    width, flat = labels.shape[1], labels.reshape(-1)
    steps = _DY * width + _DX
    begin = row * width + column
    first = _WEST
    for turn in range(1, 9):
        first = (_WEST - turn) & 7  # clockwise
        if flat[begin + steps[first]] != 0:
            break
    else:
        flat[begin] = _LEFT
        pixels[at, 0], pixels[at, 1] = column - 1, row - 1
        return at + 1
    last, here, back = begin + steps[first], begin, first
    x, y = column - 1, row - 1
    while True:
        left, k, beside = False, back, here
        for _ in range(8):
            k = (k + 1) & 7
            beside = here + steps[np.uint64(k)]
            if flat[np.uint64(beside)] != 0:
                break
            left |= k == 0
        if left:
            flat[here] = _LEFT
        elif flat[here] == _SET:
            flat[here] = _ENTERED
        pixels[at, 0], pixels[at, 1] = x, y
        at += 1
        if beside == begin and here == last:
            return at
        x, y = x + _DX[np.uint64(k)], y + _DY[np.uint64(k)]
        here, back = beside, (k + 4) & 7
