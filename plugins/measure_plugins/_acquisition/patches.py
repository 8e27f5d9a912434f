"""Segments of one colour in a reduced picture: median filter, and their borders."""

from __future__ import annotations

import cv2
import numpy as np

from measure.arrays import Bytes, Ints

OFF = 2
"""Value of a mask outside the picture."""


def majority(bits: Bytes) -> Bytes:
    """A 3 x 3 median filter of every bit; pixels at the picture's border count twice.

    Args:
        bits: (h, w) colours of each pixel.
    """
    out, there = np.zeros_like(bits), int(np.bitwise_or.reduce(bits, axis=None))
    for bit in (1 << k for k in range(8)):
        if there & bit:
            out |= np.asarray(cv2.medianBlur(bits & np.uint8(bit), 3), np.uint8)
    return out


def framed(bits: Bytes, bit: int) -> Bytes:
    """(h + 2, w + 2): 1 where pixels have a colour, 0 where not, in a margin of OFF."""
    out = np.full((bits.shape[0] + 2, bits.shape[1] + 2), np.uint8(OFF))
    out[1:-1, 1:-1] = (bits & np.uint8(bit)) != 0
    return out


def borders(mask: Bytes, least: int) -> list[Ints]:
    """Outer borders of a colour's patches, those further up first.

    Args:
        mask: (h + 2, w + 2) of the colour, see `framed`.
        least: borders with fewer pixels are left out.

    Returns:
        (n, 2) pixels x, y of each, in order.
    """
    inner = np.ascontiguousarray(mask[1:-1, 1:-1])
    found, _ = cv2.findContours(inner, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.array(one[:, 0], np.int64) for one in reversed(found) if len(one) >= least]
