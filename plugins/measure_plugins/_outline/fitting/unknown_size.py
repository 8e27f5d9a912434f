"""Outlines of balls whose size nobody knows: half-level crossings, not corrected, near and far."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.lens import bearing
from measure_plugins._outline.fitting.covariance import in_pieces
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
from measure_plugins._outline.fitting.robust_cone import FURTHEST_PX
from measure_plugins._outline.fitting.scan import Look, Search, View, look_roughly

_TURNS = 8
_CHANCE = np.sqrt(1 - np.sqrt(INLIER)) * FURTHEST_PX / SEARCH_PX
"""Share of the edges that lie anywhere, not on the ball's outline, which agree with it too."""
_LEAST_TOLD = 0.05
_FAR_SHARE, _SETTLED_SHARE = 0.67, 0.9
"""Shares of the least agreement in the end below which a quick look is the last: quick looks are
less sharp, and those from further away see only about where an outline is."""
_CIRCLE_REACH = 0.2
"""How far an outline may be from a circle found by colour, as a share of its radius."""
_SETTLED_PX = 0.5
"""Outlines are looked at again until the axis moves less."""
_GROWTH = (0.0, 1e3)
"""Mean and sd in px by which an outline shows larger than expected: nothing known."""


@compiled
def approach(
    view: View, circle: Floats, rays: int, min_contrast: float, agreement: float
) -> tuple[Floats, float]:
    """Go from a rough circle to about where its outline is, by the nearest pixels.

    Args:
        view: where to look.
        circle: (5,) of which the first are centre x, y and radius, px.
        rays: across the outline.
        min_contrast: see `Search`.
        agreement: the least share of edges that agree in the end.

    Returns:
        Unit axis (3,) and half angle of the outline, half angle 0 if there is none.
    """
    axis, radius = bearing(circle[:2], view.lens), circle[2]
    half_angle = 2 * radius / (view.lens[0] + view.lens[3])
    far = _CIRCLE_REACH * radius
    search = unhidden(axis, half_angle, far, rays, min_contrast, 0.0)
    reach = reach_px(view, search)
    for turn in range(_TURNS):
        look = look_roughly(view, search, axis, half_angle, reach, True)
        fit = fit_look(look, _GROWTH, turn == 0)
        settled = turn > 0 and moved(fit) < _SETTLED_PX
        share = _SETTLED_SHARE if settled else _FAR_SHARE
        if not np.isfinite(fit.scale) or agreeing_share(look, fit) < share * agreement:
            break
        axis = turned(look, fit)
        half_angle += fit.solution[2] / np.mean(look.scale)
        if settled:
            return axis, half_angle
        reach = SEARCH_PX
    return axis, 0.0


@compiled
def unhidden(
    axis: Floats,
    half_angle: float,
    far: float,
    rays: int,
    min_contrast: float,
    margin_px: float,
) -> Search:
    """How to look for an outline when nobody knows of any ball in front of it."""
    none, unknown = np.empty((0, 4)), np.eye(2)
    return Search(axis, half_angle, none, none, far, rays, min_contrast, margin_px, np.inf, unknown)


@compiled
def measure_roughly(view: View, search: Search, hopeless: float) -> Outline:
    """Measure an outline whose size nobody knows, by its half-level crossings.

    Args:
        view: where to look.
        search: for what.
        hopeless: a near look in which a smaller share of edges agrees is the last.
    """
    axis, half_angle, reach = search.axis, search.half_angle, reach_px(view, search)
    for turn in range(_TURNS):
        look = look_roughly(view, search, axis, half_angle, reach)
        near = reach <= SEARCH_PX
        fit = fit_look(look, _GROWTH, (turn == 0 and search.reach_px > 0) or not near)
        if not np.isfinite(fit.scale):
            break
        if near and moved(fit) < _SETTLED_PX:
            share = agreeing_share(look, fit)
            spread, wider = _doubts(look, fit, share)
            return outline_of(view, look, half_angle, fit, share, spread, wider)
        if turn > 0 and agreeing_share(look, fit) < hopeless:
            break
        axis = turned(look, fit)
        half_angle += fit.solution[2] / np.mean(look.scale)
        reach = SEARCH_PX
    return no_outline(search)


@compiled
def _doubts(look: Look, fit: Fit, share: float) -> tuple[Floats, float]:
    """How surely an axis is known by edges that are not corrected and may be another thing's.

    Where h of the rays disagree, some of the others agree by chance: what is left of the agreement
    is all that tells where the outline is (chance-corrected agreement, Cohen 1960).

    Returns:
        Its covariance (2, 2) along e1 and e2, px^2; by how much it is wider than the fit's.
    """
    told = max((share - _CHANCE) / (1 - _CHANCE), _LEAST_TOLD)
    weights, off = residuals(look, fit, 0.0)
    spread = in_pieces(look.rays.around, weights, off, fit.normal)
    wider = np.sqrt(np.trace(spread) / np.trace(np.linalg.inv(fit.normal)[:2, :2])) / told
    return spread / told**2, wider
