"""How far an outline is off where a look finds it off by a pixel.

The prediction of the picture is fitted to it at the place where the outline is looked for, and
takes up part of a displacement: how much depends on the light on the ball, on its size and on what
it mirrors, and hardly changes from picture to picture.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, folded
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.fitting.outline import Fit, fit_look
from measure_plugins._outline.fitting.scan import Look, Search, View, light_about, look_closely
from measure_plugins._outline.sampling.rays import frame_about, radius_px

CORRECTED_GROWTH = (0.0, 0.3)
"""Mean and sd in px by which corrected edges show an outline of known distance larger."""
_ASIDE_PX = 0.3
_LEAST = 1e-3
"""Determinant of what is shown of displacements below which nothing can be made of them."""
_MOST = 1.0
"""How far gains go beyond one (Frobenius norm): of a look that hardly answers, not all is made."""


@compiled
def restore(look: Look, fit: Fit, gain: Floats) -> None:
    """Move a fit's axis, and the edges with it, all the way that it was found off in part."""
    found = fit.solution[:2].copy()
    for a in range(2):
        fit.solution[a] = gain[a, 0] * found[0] + gain[a, 1] * found[1]
    more = fit.solution[:2] - found
    around = look.rays.around
    for i in range(len(around)):
        look.edges.shifts[i] += around[i, 0] * more[0] + around[i, 1] * more[1]


@folded
def measured_gain(view: View, search: Search, radial: Radial) -> Floats:
    """How far (2, 2) an axis is off, along e1 and e2, per px that a look finds it off.

    Measured by looks from either side of a settled outline: the inverse of what they show of it.

    Args:
        view: the picture.
        search: the outline, settled.
        radial: see `close_outlines.measure_closely`.
    """
    axis, shown = search.axis, np.zeros((2, 2))
    ambient = light_about(view, search, axis, radial)
    frame, scale = frame_about(axis), radius_px(axis, search.half_angle, view.lens)
    for k in range(2):
        for side in (-1, 1):
            aside = axis + side * _ASIDE_PX * search.half_angle / scale * frame[k]
            aside /= np.sqrt(np.sum(aside * aside))
            look = look_closely(view, search, aside, search.half_angle, radial, ambient)
            fit = fit_look(look, CORRECTED_GROWTH, False)
            if not np.isfinite(fit.scale):
                return np.eye(2)
            for a in range(2):
                shown[a, k] -= side * fit.solution[a] / (2 * _ASIDE_PX)
    det = shown[0, 0] * shown[1, 1] - shown[0, 1] * shown[1, 0]
    if not det > _LEAST:
        return np.eye(2)
    more = np.array([[shown[1, 1], -shown[0, 1]], [-shown[1, 0], shown[0, 0]]]) / det - np.eye(2)
    return np.eye(2) + more * min(1.0, _MOST / (np.sqrt(np.sum(more * more)) + 1e-12))
