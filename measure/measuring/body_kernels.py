"""Distances between balls, compiled: see `body_checks`."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled


@compiled
def pair_distances(points_body: Floats, centers: Floats, covariances: Floats) -> Floats:
    """How far each two of n balls are apart, the first with the second, the third and so on.

    Args:
        points_body: (n, 3) centres in the body file, mm.
        centers: (n, 3) as measured, mm.
        covariances: (n, 3, 3) of those.

    Returns:
        (n (n - 1) / 2, 3) as measured, as the file says, and the standard deviation, mm.
    """
    n, row = len(centers), 0
    out = np.empty((n * (n - 1) // 2, 3))
    for i in range(n):
        for j in range(i + 1, n):
            apart, told = centers[i] - centers[j], points_body[i] - points_body[j]
            out[row, 0], out[row, 1] = np.sqrt(np.sum(apart * apart)), np.sqrt(np.sum(told * told))
            along, variance = apart / max(out[row, 0], 1e-9), 0.0
            for a in range(3):
                for b in range(3):
                    noise = covariances[i, a, b] + covariances[j, a, b]
                    variance += along[a] * noise * along[b]
            out[row, 2] = np.sqrt(variance)
            row += 1
    return out
