"""Covariances of pixels and of points in compiled code."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled


@compiled
def inverse_2x2(m: Floats) -> Floats:
    """The inverse of a matrix (2, 2)."""
    out = np.empty((2, 2))
    determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    out[0, 0], out[0, 1] = m[1, 1] / determinant, -m[0, 1] / determinant
    out[1, 0], out[1, 1] = -m[1, 0] / determinant, m[0, 0] / determinant
    return out


@compiled
def squared_distance(off: Floats, inverse: Floats) -> float:
    """The squared Mahalanobis distance of `off` (2,), by an inverse covariance (2, 2)."""
    across = inverse[0, 1] + inverse[1, 0]
    u, v = off[0], off[1]
    return float(u * u * inverse[0, 0] + u * v * across + v * v * inverse[1, 1])
