"""How an outline's edges spread about it, and what that means for its centre in the picture."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.compiling import compiled
from measure.model.lens import to_pixel

_BLOCKS = 12


@compiled
def image_directions(frame: Floats, lens: Floats) -> Floats:
    """Image (2, 2) of a turn by one radian of the axis along e1 and e2: columns in px."""
    h = 1e-6
    out = np.empty((2, 2))
    for k in range(2):
        a, b = frame[2] + h * frame[k], frame[2] - h * frame[k]
        u1, v1 = to_pixel(a[0], a[1], a[2], lens)
        u2, v2 = to_pixel(b[0], b[1], b[2], lens)
        out[0, k], out[1, k] = (u1 - u2) / (2 * h), (v1 - v2) / (2 * h)
    return out


@compiled
def correlation(standard: Floats, inliers: Bools) -> float:
    """How much wider than for independent rays a mean over the outline scatters (batch means).

    Neighbouring rays share pixels, shading and what stands behind: their errors go together.
    """
    n = len(standard)
    squares, rays, blocks = 0.0, 0, 0
    for block in range(_BLOCKS):
        total, count = 0.0, 0
        for i in range(block * n // _BLOCKS, (block + 1) * n // _BLOCKS):
            if inliers[i]:
                total += standard[i]
                count += 1
        if count > 1:
            squares += total * total
            rays += count
            blocks += 1
    return max(1.0, squares / rays) if blocks >= 4 else 4.0
