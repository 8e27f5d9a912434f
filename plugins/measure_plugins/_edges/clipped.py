"""Rays on which light is clipped: they show neither how bright a ball is nor where its edge rises.

A sensor that is full shows all that is brighter alike. Blurred before it is clipped, the edge of
such a ball seems to lie further out and to be steeper than any blur or tone curve explains.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Bytes, Floats, Reals
from measure.compiling import compiled
from measure.model.frames import FULL
from measure_plugins._edges.rays import FREE
from measure_plugins._edges.selection import median

_WHITE, _PALE = 0.93, 0.6
"""Picture values, from 0 to 1, of a highlight that is full or nearly so, in all colours; and of
balls that are about as white themselves."""
HIGHLIGHT_PX = 0.5
"""How far edges may be off that begin in such a highlight. Of two values tried, with the truth in
view, 1 was worse before desk lamps."""


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
    return np.asarray(np.any(pixels[row, column] >= FULL, axis=(0, 2)))


@compiled
def in_highlights(inside: Reals, free: Floats) -> Bools:
    """Which of n rays begin in a highlight that is white, where the ball is not.

    Near the rim, what ends there is the highlight: the ball goes on beyond it, dark.

    Args:
        inside: (3, n) picture values inside the outline, from 0 to 1.
        free: (n,) `rays.FREE` where nothing is in the way.
    """
    n = inside.shape[1]
    out, some, count = np.zeros(n, np.bool_), np.empty(n), 0
    for i in range(n):
        white = min(inside[0, i], min(inside[1, i], inside[2, i]))
        out[i] = white > _WHITE
        if free[i] == FREE:
            some[count] = white
            count += 1
    if count == 0 or median(some, count) >= _PALE:
        out[:] = False
    return out
