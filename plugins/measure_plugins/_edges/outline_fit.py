"""One ball's outline in one picture: look, fit the cone; and again, about it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.model.lens import bearing_and_slopes, to_pixel
from measure_plugins._edges.cone_fit import FURTHEST_PX, consensus, refine
from measure_plugins._edges.corrected import SEARCH_PX
from measure_plugins._edges.look import Look, Search, View, lamps_shine, look_closely, look_roughly
from measure_plugins._edges.radial import Radial
from measure_plugins._edges.rays import FREE
from measure_plugins._edges.selection import kth_smallest
from measure_plugins._edges.spread import center_covariance, image_directions, in_pieces

_CONSENSUS_TRIALS = 60
_CONSENSUS_GATE_PX = 1.2
_FIRST_GATE_PX = 2.5
_TURNS = 8
_FEWEST_EDGES = 6
_INLIER = 0.1
_CHANCE = np.sqrt(1 - np.sqrt(_INLIER)) * FURTHEST_PX / SEARCH_PX
"""Share of the edges that lie anywhere, not on the ball's outline, which agree with it too."""
_LEAST_TOLD = 0.05
_FAR_SHARE, _SETTLED_SHARE = 0.67, 0.9
"""Shares of the least agreement in the end below which a quick look is the last: quick looks are
less sharp, and those from further away see only about where an outline is."""
_CIRCLE_REACH = 0.2
"""How far an outline may be from a circle found by colour, as a share of its radius."""
_ROUGHLY_SETTLED_PX = 0.5
_SETTLED_PX = 0.1
"""Corrected edges are looked at again until the axis moves less: the prediction, fitted at a place
that is off, takes up part of the error. Before the correction half a pixel will do."""
_CONVINCING = 0.75
"""Share of the rays that should show an edge whose edges agree, that rules out a look elsewhere."""
_GROWTH_UNKNOWN = (0.0, 1e3)
_GROWTH_SEEN = (-0.5, 0.5)
_GROWTH_CORRECTED = (0.0, 0.3)
"""Mean and sd in px by which an outline shows larger than one predicted from a known distance:
nothing known; diffuse light fades at grazing angles, so a ball's edge lies inside its outline; and
with that taken off."""


class Outline(NamedTuple):
    """A measured outline.

    Attributes:
        axis: (3,) unit direction of the sphere's centre in the camera frame.
        half_angle: the cone's half angle, rad, as the edges show it.
        center_px: (2,) image of the sphere's centre.
        radius_px: mean radius of the outline.
        covariance_px: (2, 2) of `center_px`.
        points_px: (n, 2) edge points that agree with the cone.
        sd_px: (n,) their standard deviations along the normal.
        clear: number of rays with nothing in their way and unlike colours at their ends.
        overflow: number of clear-way rays outside which the ball's own colour goes on.
        agreeing: number of rays whose edge agrees with the cone; 0 if no cone was found.
        scatter_px: robust scatter of the edges about the cone.
    """

    axis: Floats
    half_angle: float
    center_px: Floats
    radius_px: float
    covariance_px: Floats
    points_px: Floats
    sd_px: Floats
    clear: int
    overflow: int
    agreeing: int
    scatter_px: float


class _Fit(NamedTuple):
    """See `cone_fit.refine`; `scale` is infinite where there is no cone."""

    solution: Floats
    normal: Floats
    weights: Floats
    scale: float


@compiled
def approach(
    view: View, circles: Floats, rays: int, min_contrast: float, agreement: float
) -> Floats:
    """Go from rough circles to about where their outlines are, by the nearest pixels.

    Args:
        view: where to look.
        circles: (k, 5) of which the first are centre x, y and radius, px.
        rays: across each outline.
        min_contrast: see `Search`.
        agreement: the least share of edges that agree in the end.

    Returns:
        (k, 5) unit axis and half angle of each outline, half angle 0 where there is none; and the
        ball's distance: infinite, as nobody knows which of them is in front of which.
    """
    out = np.zeros((len(circles), 5))
    out[:, 4] = np.inf
    slopes, nearer = np.empty(6), np.empty((0, 4))
    for i, circle in enumerate(circles):
        axis, radius = np.empty(3), circle[2]
        bearing_and_slopes(circle[:2], view.lens, 0.0, 0.0, axis, slopes)
        half_angle = 2 * radius / (view.lens[0] + view.lens[3])
        search = Search(axis, half_angle, nearer, _CIRCLE_REACH * radius, rays, min_contrast, 0.0)
        reach = _reach(view, search)
        for turn in range(_TURNS):
            look = look_roughly(view, search, axis, half_angle, reach, True)
            fit = _fit(look, _GROWTH_UNKNOWN, turn == 0)
            settled = turn > 0 and _moved(fit) < _ROUGHLY_SETTLED_PX
            share = _SETTLED_SHARE if settled else _FAR_SHARE
            if not np.isfinite(fit.scale) or _agreement(look, fit) < share * agreement:
                break
            axis = _turned(look, fit)
            half_angle += fit.solution[2] / np.mean(look.scale)
            if settled:
                out[i, :3], out[i, 3] = axis, half_angle
                break
            reach = SEARCH_PX
    return out


@compiled
def measure_roughly(view: View, search: Search, hopeless: float) -> Outline:
    """Measure an outline whose size nobody knows, by its half-level crossings.

    Args:
        view: where to look.
        search: for what.
        hopeless: a near look in which a smaller share of edges agrees is the last.
    """
    axis, half_angle, reach = search.axis, search.half_angle, _reach(view, search)
    for turn in range(_TURNS):
        look = look_roughly(view, search, axis, half_angle, reach)
        near = reach <= SEARCH_PX
        fit = _fit(look, _GROWTH_UNKNOWN, (turn == 0 and search.reach_px > 0) or not near)
        if not np.isfinite(fit.scale):
            break
        if near and _moved(fit) < _ROUGHLY_SETTLED_PX:
            return _doubted(_outline(view, look, half_angle, fit), view, look, fit)
        if turn > 0 and _agreement(look, fit) < hopeless:
            break
        axis = _turned(look, fit)
        half_angle += fit.solution[2] / np.mean(look.scale)
        reach = SEARCH_PX
    return _nothing(search)


@compiled
def _doubted(outline: Outline, view: View, look: Look, fit: _Fit) -> Outline:
    """The same with the covariance of edges that are not corrected and may be another thing's.

    Where h of the rays disagree, some of the others agree by chance: what is left of the agreement
    is all that tells where the outline is (chance-corrected agreement, Cohen 1960).
    """
    told = max((_agreement(look, fit) - _CHANCE) / (1 - _CHANCE), _LEAST_TOLD)
    sd = look.edges.sd * fit.scale
    spread = in_pieces(look.edges.shifts, sd, look.around, fit.weights, fit.solution, fit.normal)
    wider = np.sqrt(np.trace(spread) / np.trace(np.linalg.inv(fit.normal)[:2, :2])) / told
    to_image = image_directions(look.frame, view.lens) / np.mean(look.scale)
    return Outline(
        outline.axis,
        outline.half_angle,
        outline.center_px,
        outline.radius_px,
        to_image @ (spread / told**2) @ to_image.T,
        outline.points_px,
        wider * outline.sd_px,
        outline.clear,
        outline.overflow,
        outline.agreeing,
        outline.scatter_px,
    )


@compiled
def measure_closely(view: View, search: Search, radial: Radial) -> Outline:
    """Measure an outline of known size by corrected edges, from the prediction if that will do.

    A wide look sees much besides the outline, and is often further off than the prediction: it is
    taken only where corrected edges about the prediction do not agree.
    """
    near, reach = _settled(view, search, radial, search.axis, True), _reach(view, search)
    if reach <= SEARCH_PX or near.agreeing >= _CONVINCING * max(near.clear + near.overflow, 1):
        return near
    look = look_roughly(view, search, search.axis, search.half_angle, reach)
    fit = _fit(look, _GROWTH_SEEN, True)
    if not np.isfinite(fit.scale):
        return near
    far = _settled(view, search, radial, _turned(look, fit), False)
    return far if far.agreeing > near.agreeing else near


@compiled
def _settled(view: View, search: Search, radial: Radial, axis: Floats, first: bool) -> Outline:
    """The outline that corrected looks lead to from `axis`; `first` if nobody looked there yet."""
    before, lit = np.zeros(2), lamps_shine(view, axis, search.rays, radial)
    for turn in range(_TURNS):
        look = look_closely(view, search, axis, search.half_angle, radial, lit)
        fit = _fit(look, _GROWTH_CORRECTED, first and turn == 0)
        if not np.isfinite(fit.scale):
            break
        if _moved(fit) < _SETTLED_PX:
            return _outline(view, look, search.half_angle, fit)
        step = fit.solution[:2]
        if np.sum(step * before) < 0:
            step *= 0.5  # else looks may lead to and fro for ever
        before = step
        axis = _turned(look, fit)
    return _nothing(search)


@compiled
def _reach(view: View, search: Search) -> float:
    """How far to search, px: not so far that the ball's other side would be met."""
    return min(max(search.reach_px, SEARCH_PX), 0.3 * search.half_angle * view.lens[0])


@compiled
def _fit(look: Look, growth: tuple[float, float], first: bool) -> _Fit:
    """The robust cone through one look's edges."""
    if np.sum(look.use) < _FEWEST_EDGES:
        return _Fit(np.zeros(3), np.zeros((3, 3)), look.use, np.inf)
    start, gate = np.zeros(3), SEARCH_PX
    shifts, sd = look.edges.shifts, look.edges.sd
    if first:
        start = consensus(shifts, look.around, look.use, _CONSENSUS_GATE_PX, _CONSENSUS_TRIALS)
        gate = _FIRST_GATE_PX
    solution, normal, weights, scale = refine(
        shifts, look.around, sd, look.use, start, gate, growth
    )
    return _Fit(solution, normal, weights, scale)


@compiled
def _moved(fit: _Fit) -> float:
    return max(abs(fit.solution[0]), abs(fit.solution[1]))


@compiled
def _agreement(look: Look, fit: _Fit) -> float:
    """Share of the rays that should show an edge whose edges lie on one outline."""
    inliers = np.nonzero(fit.weights > _INLIER)[0]
    return len(inliers) / max(np.sum(look.clear) + _overflow(look, inliers), 1.0)


@compiled
def _turned(look: Look, fit: _Fit) -> Floats:
    """The axis (3,) that a fit has found."""
    turn_by = fit.solution[0] * look.frame[0] + fit.solution[1] * look.frame[1]
    axis = look.frame[2] + turn_by / np.mean(look.scale)
    return axis / np.sqrt(np.sum(axis * axis))


@compiled
def _nothing(search: Search) -> Outline:
    none = np.empty(0)
    return Outline(
        search.axis, 0.0, np.zeros(2), 0.0, np.zeros((2, 2)), none.reshape(0, 2), none, 0, 0, 0, 0.0
    )


@compiled
def _outline(view: View, look: Look, half_angle: float, fit: _Fit) -> Outline:
    px, axis = np.mean(look.scale), _turned(look, fit)
    center = np.array(to_pixel(axis[0], axis[1], axis[2], view.lens))
    inliers = np.nonzero(fit.weights > _INLIER)[0]
    points, sd = np.empty((len(inliers), 2)), np.empty(len(inliers))
    off, weights = np.zeros(len(fit.weights)), np.zeros(len(fit.weights))
    for k, i in enumerate(inliers):
        s, ray_sd = look.edges.shifts[i], look.edges.sd[i]
        points[k, 0] = look.points[i, 0] + s * look.normals[i, 0]
        points[k, 1] = look.points[i, 1] + s * look.normals[i, 1]
        sd[k] = ray_sd * max(fit.scale, 1.0)
        along = look.around[i, 0] * fit.solution[0] + look.around[i, 1] * fit.solution[1]
        off[i] = s - along - fit.solution[2]
        weights[i] = fit.weights[i] / (ray_sd * fit.scale) ** 2
    radius = float(fit.solution[2])
    for u, v in look.points:
        radius += np.hypot(u - center[0], v - center[1]) / len(look.points)
    to_image = image_directions(look.frame, view.lens) / px
    spread = center_covariance(look.around, weights, off, fit.normal)
    middle = len(sd) // 2
    return Outline(
        axis,
        half_angle + fit.solution[2] / px,
        center,
        radius,
        to_image @ spread @ to_image.T,
        points,
        sd,
        int(np.sum(look.clear)),
        _overflow(look, inliers),
        len(inliers),
        fit.scale * kth_smallest(look.edges.sd[inliers], len(sd), middle) if len(sd) else 0.0,
    )


@compiled
def _overflow(look: Look, inliers: Ints) -> int:
    """Rays without an edge whose outside looks like the ball, not like what is round it."""
    if len(inliers) == 0:
        return 0
    ball, ground = np.zeros(3), np.zeros(3)
    for i in inliers:
        ball += look.edges.inside[:, i] / len(inliers)
        ground += look.edges.outside[:, i] / len(inliers)
    count = 0
    for i in range(len(look.free)):
        if look.free[i] == FREE and look.clear[i] == 0:
            to_ball, to_ground = look.edges.outside[:, i] - ball, look.edges.outside[:, i] - ground
            count += int(np.sum(to_ball**2) < np.sum(to_ground**2))
    return count
