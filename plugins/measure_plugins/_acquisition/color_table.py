"""Colours of pixels by one table look-up each."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from measure.arrays import Bytes
from measure.compiling import compiled
from measure.model import BallColor

_BITS = 6
_LEVELS = 1 << _BITS
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
    level = (np.arange(_LEVELS) * (256 // _LEVELS) + 128 // _LEVELS).astype(np.uint8)
    blue, green, red = np.meshgrid(level, level, level, indexing="ij")
    samples = np.stack([blue, green, red], axis=-1).reshape(_LEVELS, -1, 3)
    table = np.zeros(samples.shape[:2], np.uint8)
    for bit, color in enumerate(colors):
        table |= np.where(color.mask(samples) > 0, np.uint8(1 << bit), np.uint8(0))
    table = table.reshape(_LEVELS, _LEVELS, _LEVELS)
    table.setflags(write=False)
    return table


@compiled
def classify(pixels: Bytes, table: Bytes, sparse: Bytes, step: int) -> tuple[Bytes, Bytes]:
    """Colour bits of an image reduced by `step`; of every other pixel each way by another table.

    Each reduced pixel is the mean of four pixels near the middle of its block: enough to tame noise
    and the demosaic's colour fringes, and a quarter of the reading that a full mean takes.

    Args:
        pixels: BGR (h, w, 3).
        table: from `color_table`.
        sparse: another one.
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
