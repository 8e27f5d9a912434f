"""Rays on which light is clipped: they show neither how bright a ball is nor where its edge rises.

A sensor that is full shows all that is brighter alike. Blurred before it is clipped, the edge of
such a ball seems to lie further out and to be steeper than any blur or tone curve explains.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Bytes, Floats

_FULL = 250
"""Picture values from here on may be clipped: JPEG moves them by some levels."""


def clipped(pixels: Bytes, points: Floats, normals: Floats, steps: Floats) -> Bools:
    """Which of n rays meet a pixel of which one colour is full.

    Args:
        pixels: (h, w, 3).
        points: (n, 2) where the rays begin, px.
        normals: (n, 2) their unit directions.
        steps: (m,) where they are looked at, px.
    """
    at = np.rint(points + steps[:, None, None] * normals).astype(np.intp)
    height, width = pixels.shape[:2]
    column, row = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
    return np.asarray(np.any(pixels[row, column] >= _FULL, axis=(0, 2)))
