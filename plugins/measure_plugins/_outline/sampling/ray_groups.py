"""Groups of neighbouring rays, to whose mean profile the predicted picture is fitted.

A prediction fitted to one ray would follow the noise of that ray, and the correction would then
subtract the effect of the noise. The mean of two neighbours has less of it, and halves the work.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Reals
from measure.compiling import compiled
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

TOGETHER = 2
"""Rays in a group; with three, which are further apart, predictions are worse."""


@compiled
def middle_angles(around: Floats) -> Floats:
    """Cosine and sine (n / 2, 2) of the angles midway between the rays of each group (n, 2)."""
    out = np.zeros((len(around) // TOGETHER, 2))
    for i in range(len(out)):
        x, y = 0.0, 0.0
        for k in range(TOGETHER):
            x += around[TOGETHER * i + k, 0]
            y += around[TOGETHER * i + k, 1]
        length = np.sqrt(x * x + y * y)
        out[i, 0], out[i, 1] = x / length, y / length
    return out


@compiled
def together(light: Reals, status: Statuses) -> tuple[Floats, Statuses]:
    """Mean light of the clear rays of each group, and the status of the groups.

    Args:
        light: (3, m, n) along the rays.
        status: (n,) see `RaySet`.

    Returns:
        Light (3, m, n / 2); and status (n / 2,): CLEAR where a ray is, else that of the first.
    """
    colors, m, n = light.shape
    groups = n // TOGETHER
    weights, grouped = np.zeros((TOGETHER, groups)), np.empty(groups, np.int8)
    for i in range(groups):
        count = 0
        for k in range(TOGETHER):
            count += int(status[TOGETHER * i + k] == CLEAR)
        grouped[i] = CLEAR if count > 0 else status[TOGETHER * i]
        for k in range(TOGETHER):
            weights[k, i] = 1 / count if status[TOGETHER * i + k] == CLEAR else 0.0
    out = np.empty((colors, m, groups))
    for c in range(colors):
        for j in range(m):
            for i in range(groups):
                total = 0.0
                for k in range(TOGETHER):
                    total += weights[k, i] * light[c, j, TOGETHER * i + k]
                out[c, j, i] = total
    return out, grouped
