"""The play operators over a whole trajectory, compiled; apart, for numba is slow to load."""

from __future__ import annotations

import numba
import numpy as np

from measure.arrays import Floats


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def play(mixed: Floats, widths: Floats) -> Floats:
    """Features (n, combinations x widths) of mixed joints (n, combinations), from rest."""
    count, combinations = mixed.shape
    sizes = widths.shape[1]
    out = np.empty((count, combinations * sizes))
    for c in range(combinations):
        for k in range(sizes):
            width, y = widths[c, k], mixed[0, c]
            for n in range(count):
                x = mixed[n, c]
                y = min(max(y, x - width), x + width)
                out[n, c * sizes + k] = (x - y) / width
    return out
