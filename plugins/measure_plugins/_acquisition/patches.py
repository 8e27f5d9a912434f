"""Segments of one colour in a reduced picture: median filter, and tracing of borders."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Ints
from measure.compiling import compiled

_DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])
_DY = np.array([0, -1, -1, -1, 0, 1, 1, 1])
"""The eight neighbours of a pixel, counter-clockwise from the right in the displayed picture."""
_WEST = 4
_ALL = 0xFF  # All eight neighbours: such a pixel lies on no border
_WORD = 8  # Pixels tested at once, to skip those on no border
OFF = 2
"""Value of a mask outside the picture."""
_EDGE, _ENTERED, _LEFT = 1, 2, 3
"""Labels of pixels on borders: not traced yet; traced; traced, and without the colour to the
right."""


def _turns() -> Ints:
    """The next neighbour along a border.

    Returns:
        (8, 256) by the neighbour that the border comes from and by the set of neighbours of the
        colour: the first of these counter-clockwise, plus eight if the right one is passed over.
    """
    out = np.zeros((8, 256), np.int64)
    for back in range(8):
        for neighbours in range(1, 256):
            turn = 1
            while not neighbours >> (back + turn & 7) & 1:
                turn += 1
            passed = [back + k & 7 for k in range(1, turn)]
            out[back, neighbours] = (back + turn & 7) + 8 * (0 in passed)
    return out


_TURNS = _turns()


@compiled
def majority(bits: Bytes) -> Bytes:
    """A 3 x 3 median filter of every bit.

    The nine pixels are counted by bitwise full adders, all colours at once. Pixels at the picture's
    border count their neighbours there twice.

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
def framed(bits: Bytes, bit: int) -> Bytes:
    """(h + 2, w + 2): 1 where pixels have a colour, 0 where not, in a margin of OFF."""
    (h, w), one = bits.shape, np.uint8(bit)
    out = np.full((h + 2, w + 2), np.uint8(OFF))
    for i in range(h):
        colors, row = bits[i], out[i + 1, 1 : w + 1]
        for j in range(w):
            row[j] = np.uint8(np.uint8(colors[j] & one) == one)
    return out


@compiled
def borders(mask: Bytes, least: int) -> tuple[Ints, Ints]:
    """Outer borders of a colour's patches, each in order (Suzuki and Abe 1985, algorithm 2).

    Args:
        mask: (h + 2, w + 2) of the colour, see `framed`.
        least: borders with fewer pixels are left out.

    Returns:
        (n, 2) pixels x, y of one border after the other; (patches,) the row after each one's last.
    """
    neighbours, labels = _labels(mask)
    words = labels.view(np.uint64)
    edges = _WORD * np.count_nonzero(words)  # at most
    pixels = np.empty((4 * edges, 2), np.int64)  # a border passes a pixel four times at most
    ends = np.empty(edges, np.int64)
    count, total = 0, 0
    for i in range(1, len(mask) - 1):
        inside = False
        for word in range(words.shape[1]):
            if words[i, word] == 0:
                continue
            for j in range(_WORD * word, _WORD * (word + 1)):
                label = labels[i, j]
                if label == _EDGE and not inside and not neighbours[i, j] >> _WEST & 1:
                    end = _trace(neighbours, labels, i, j, pixels, total)
                    label = labels[i, j]
                    if end - total >= least:
                        ends[count] = total = end
                        count += 1
                if label > _EDGE:
                    inside = label == _ENTERED
    return pixels[:total], ends[:count]


@compiled
def _labels(mask: Bytes) -> tuple[Bytes, Bytes]:
    """Neighbours of the colour, and pixels on borders, of a mask (h + 2, w + 2).

    Returns:
        (h + 2, w + 2, filled up to whole words) a bit for each of a pixel's neighbours of the
        colour; as many labels, _EDGE where a pixel of the colour has a neighbour without. Both with
        a margin of zeros.
    """
    h, w = mask.shape[0] - 2, mask.shape[1] - 2
    wide = (w + 2 + _WORD - 1) // _WORD * _WORD
    neighbours, labels = np.zeros((h + 2, wide), np.uint8), np.zeros((h + 2, wide), np.uint8)
    colored = mask & np.uint8(1)
    for i in range(1, h + 1):
        above, here, below = colored[i - 1], colored[i], colored[i + 1]
        around, row = neighbours[i], labels[i]
        for j in range(1, w + 1):
            upper = above[j + 1] << 1 | above[j] << 2 | above[j - 1] << 3
            lower = below[j - 1] << 5 | below[j] << 6 | below[j + 1] << 7
            around[j] = np.uint8(here[j + 1] | upper | here[j - 1] << _WEST | lower)
        for j in range(1, w + 1):
            row[j] = here[j] & np.uint8(around[j] != _ALL)
    return neighbours, labels


@compiled
def _trace(neighbours: Bytes, labels: Bytes, row: int, column: int, pixels: Ints, at: int) -> int:
    """Trace an outer border from its first pixel, label it, and store it from row `at` on.

    Args:
        neighbours: as from `_labels`.
        row: of the first pixel, in `labels`.
        column: of the first pixel; the one to its left is not of the colour.
        pixels: (k, 2) filled with x, y in the picture.
        at: first free row of `pixels`.

    Returns:
        The first free row afterwards.
    """
    width, flat, around = labels.shape[1], labels.reshape(-1), neighbours.reshape(-1)
    steps = _DY * width + _DX
    begin = row * width + column
    if around[begin] == 0:
        flat[begin] = _LEFT
        pixels[at, 0], pixels[at, 1] = column - 1, row - 1
        return at + 1
    first = (_WEST - 1) & 7
    while not around[begin] >> first & 1:
        first = (first - 1) & 7  # clockwise
    last, here, back = begin + steps[first], begin, np.uint64(first)
    x, y = column - 1, row - 1
    while True:
        turn = _TURNS[back, around[np.uint64(here)]]
        k = np.uint64(turn & 7)
        flat[here] = max(flat[here], _LEFT if turn > 7 else _ENTERED)
        pixels[at, 0], pixels[at, 1] = x, y
        at += 1
        beside = here + steps[k]
        if beside == begin and here == last:
            return at
        x, y = x + _DX[k], y + _DY[k]
        here, back = beside, k ^ np.uint64(4)
