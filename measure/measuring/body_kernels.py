"""Distances between balls, and from where a pose puts them, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import times


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


@compiled
def distances_from_body(
    rotation: Floats,
    translation: Floats,
    points_body: Floats,
    centers: Floats,
    covariances: Floats,
) -> Floats:
    """How far n balls are from where a pose puts them.

    Args:
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        points_body: (n, 3) centres in the body file, mm.
        centers: (n, 3) as measured, mm.
        covariances: (n, 3, 3) of those.

    Returns:
        (n, 2) squared Mahalanobis distances, and distances in mm.
    """
    out = np.empty((len(centers), 2))
    for i in range(len(centers)):
        off = centers[i] - times(rotation, points_body[i]) - translation
        out[i, 0] = np.sum(off * np.linalg.solve(covariances[i], off))
        out[i, 1] = np.sqrt(np.sum(off * off))
    return out
