"""Outlines of balls of known size: corrected edges, looked at again until they settle."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, folded
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.fitting.covariance import center_covariance
from measure_plugins._outline.fitting.edges import SEARCH_PX
from measure_plugins._outline.fitting.outline import (
    INLIER,
    Fit,
    Outline,
    agreeing_share,
    fit_look,
    moved,
    no_outline,
    outline_of,
    reach_px,
    residuals,
    turned,
)
from measure_plugins._outline.fitting.scan import (
    Search,
    View,
    light_about,
    look_closely,
    look_roughly,
)
from measure_plugins._outline.fitting.step_gain import CORRECTED_GROWTH, restore

_TURNS = 8
_SETTLED_PX, _SETTLED_SD, _FURTHEST_PX = 0.3, 3.0, 0.5
"""Corrected edges are looked at again until the axis moves less than the first, or than so many of
its standard deviations and the last: what a look finds is right to about a twentieth of the way,
and that leaves little against what the edges' scatter leaves."""
_CONVINCING = 2 / 3
"""Share of the rays that should show an edge whose edges agree, that rules out a look elsewhere."""
_GROWTH_SEEN = (-0.5, 0.5)
"""Mean and sd in px by which an outline shows larger than one predicted from a known distance:
diffuse light fades at grazing angles, so a ball's edge lies inside its outline."""


@folded
def measure_closely(view: View, search: Search, radial: Radial) -> Outline:
    """Measure an outline of known size by corrected edges, from the prediction if that will do.

    A wide look sees much besides the outline, and is often further off than the prediction: it is
    taken only where corrected edges about the prediction do not agree.
    """
    near, reach = _settled(view, search, radial, search.axis), reach_px(view, search)
    if reach <= SEARCH_PX or near.share >= _CONVINCING:
        return near
    look = look_roughly(view, search, search.axis, search.half_angle, reach)
    fit = fit_look(look, _GROWTH_SEEN, True)
    if not np.isfinite(fit.scale):
        return near
    far = _settled(view, search, radial, turned(look, fit))
    return far if far.agreeing > near.agreeing else near


@compiled
def _settled(view: View, search: Search, radial: Radial, axis: Floats) -> Outline:
    """The outline that corrected looks lead to from `axis`, the predicted one or a better one."""
    ambient = light_about(view, search, axis, radial)
    before, predicted = np.zeros(2), bool(np.all(axis == search.axis))
    for turn in range(_TURNS):
        look = look_closely(view, search, axis, search.half_angle, radial, ambient)
        fit = fit_look(look, CORRECTED_GROWTH, predicted and turn == 0)
        if not np.isfinite(fit.scale):
            break
        restore(look, fit, search.gain)
        if moved(fit) < _FURTHEST_PX:
            weights, off = residuals(look, fit, INLIER)
            spread = center_covariance(look.rays.around, weights, off, fit.normal)
            if _is_settled(fit, spread):
                share = agreeing_share(look, fit)
                return outline_of(view, look, search.half_angle, fit, share, spread, 1.0)
        step = fit.solution[:2]
        if np.sum(step * before) < 0:
            step *= 0.5  # else looks may lead to and fro for ever
        before = step
        axis = turned(look, fit)
    return no_outline(search)


@compiled
def _is_settled(fit: Fit, spread: Floats) -> bool:
    """Whether to look again would tell little; `spread` (2, 2) is the axis' covariance, px^2."""
    sd = np.sqrt((spread[0, 0] + spread[1, 1]) / 2)
    return moved(fit) < max(_SETTLED_SD * sd, _SETTLED_PX)
