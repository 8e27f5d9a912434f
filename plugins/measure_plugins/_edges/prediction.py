"""The picture a ball's model predicts along its rays, were its outline where it is predicted.

The ball's own light and what it reflects are fitted to the picture (`shading`), the surroundings
are taken as seen. Together and blurred they say what the camera would show, so the edge finder's
own error there can be measured.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._edges.radial import Radial
from measure_plugins._edges.shading import (
    GREY,
    angular_terms,
    fit_shading,
    own_color,
    radial_amounts,
    reflected_light,
    split,
)


@compiled
def predict_light(
    profiles: Floats,
    free: Floats,
    around: Floats,
    background: Floats,
    steps: Floats,
    radial: Radial,
    first: int,
) -> Floats:
    """Light (3, m - first, n) the model predicts along the rays.

    Args:
        profiles: (3, m, n) light the picture shows at `steps`.
        free: (n,) 0 for rays with a clear way.
        around: (n, 2) cosine and sine around the axis.
        background: (3, n) light outside the outline.
        steps: (m,) px along the normal.
        radial: the ball's tables at the same steps.
        first: the step at which the prediction begins.
    """
    m, n = profiles.shape[1:]
    own = own_color(profiles, free, steps)
    behind, behind_grey = np.empty(n), np.empty(n)
    split(background, own, behind, behind_grey)
    amounts, grey = np.empty((m, n)), np.empty((m, n))
    for j in range(m):
        split(profiles[:, j], own, amounts[j], grey[j])
        if radial.outside[j] > 0:
            for i in range(n):
                amounts[j, i] -= radial.outside[j] * behind[i]
                grey[j, i] -= radial.outside[j] * behind_grey[i]
    angular = angular_terms(around)
    shading = radial_amounts(fit_shading(amounts, free, angular, steps, radial.diffuse), angular)
    reflected = reflected_light(grey, free, radial.solve_grey)
    for k in range(len(reflected)):
        for i in range(n):
            tied = reflected[k, i] + radial.tie_grey[k] * behind_grey[i]
            reflected[k, i] = max(tied, 0.0)
    return _compose(own, shading, reflected, background, behind_grey, radial, first)


@compiled
def _compose(
    own: Floats,
    shading: Floats,
    reflected: Floats,
    background: Floats,
    behind_grey: Floats,
    radial: Radial,
    first: int,
) -> Floats:
    """Own light (6, n), reflected light (k, n) and surroundings (3, n), laid along the rays."""
    n = len(behind_grey)
    m = len(radial.nearby) - first
    out = np.empty((3, m, n))
    body, mirror = np.empty(n), np.empty(n)
    for j in range(m):
        at = first + j
        body[:], mirror[:] = 0.0, 0.0
        for p in range(6):
            for i in range(n):
                body[i] += radial.diffuse[at, p] * shading[p, i]
        for k in range(len(reflected)):
            for i in range(n):
                mirror[i] += radial.grey[at, k] * reflected[k, i]
        for c in range(3):
            for i in range(n):
                rest = background[c, i] - behind_grey[i] * GREY
                value = max(body[i], 0.0) * own[c] + mirror[i] * GREY
                value += radial.nearby[at] * rest + radial.outside[at] * background[c, i]
                out[c, j, i] = max(value, 0.0)
    return out
