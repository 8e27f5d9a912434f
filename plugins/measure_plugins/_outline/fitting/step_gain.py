"""Displacement of an outline per displacement that a scan with the model shows.

The prediction is fitted to the picture where the outline is assumed to be, and takes up part of its
displacement. How much depends on the light on the ball, on its size and on its reflections, and
hardly changes from picture to picture: it is measured once, and each scan's result multiplied by
the inverse. See docs/explanation/outline.md, formula 16.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, folded
from measure_plugins._outline.appearance.radial_basis import RadialTables
from measure_plugins._outline.fitting.outline import Fit, fit_scan
from measure_plugins._outline.fitting.scan import (
    CameraImage,
    EdgeScan,
    OutlineSearch,
    ambient_light,
    scan_with_model,
)
from measure_plugins._outline.sampling.rays import frame_about, radius_px

CORRECTED_GROWTH = (0.0, 0.3)
"""Prior mean and sd in px of the radius of corrected edges minus the one predicted by distance."""
_OFFSET_PX = 0.3
_MIN_DETERMINANT = 1e-3
"""Determinant of the step response below which it is not inverted."""
_MAX_EXCESS = 1.0
"""Limit of the gain minus the unit matrix (Frobenius norm), where the response is weak."""


@compiled
def apply_step_gain(scan: EdgeScan, fit: Fit, step_gain: Floats) -> None:
    """Multiply the shift of a fit's axis by the gain, and move the scan's edges along."""
    found = fit.solution[:2].copy()
    for a in range(2):
        fit.solution[a] = step_gain[a, 0] * found[0] + step_gain[a, 1] * found[1]
    more = fit.solution[:2] - found
    around = scan.rays.around
    for i in range(len(around)):
        scan.edges.shifts[i] += around[i, 0] * more[0] + around[i, 1] * more[1]


@folded
def measure_step_gain(view: CameraImage, search: OutlineSearch, tables: RadialTables) -> Floats:
    """Displacement (2, 2) of the axis along e1 and e2, px per px that a scan shows.

    The inverse of the response to displacements of `_OFFSET_PX` to either side of the outline that
    `search` holds, which must have converged.
    """
    axis, response = search.axis, np.zeros((2, 2))
    ambient = ambient_light(view, search, axis, tables)
    frame, scale = frame_about(axis), radius_px(axis, search.half_angle, view.lens)
    for k in range(2):
        for side in (-1, 1):
            offset = axis + side * _OFFSET_PX * search.half_angle / scale * frame[k]
            offset /= np.sqrt(np.sum(offset * offset))
            scan = scan_with_model(view, search, offset, search.half_angle, tables, ambient)
            fit = fit_scan(scan, CORRECTED_GROWTH, False)
            if not np.isfinite(fit.scale):
                return np.eye(2)
            for a in range(2):
                response[a, k] -= side * fit.solution[a] / (2 * _OFFSET_PX)
    det = response[0, 0] * response[1, 1] - response[0, 1] * response[1, 0]
    if not det > _MIN_DETERMINANT:
        return np.eye(2)
    adjugate = np.array([[response[1, 1], -response[0, 1]], [-response[1, 0], response[0, 0]]])
    more = adjugate / det - np.eye(2)
    return np.eye(2) + more * min(1.0, _MAX_EXCESS / (np.sqrt(np.sum(more * more)) + 1e-12))
