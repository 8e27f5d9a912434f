"""The cone fitted to what one look at a ball shows, and the outline that makes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.model.lens import to_pixel
from measure_plugins._kernels.selection import nearly_kth
from measure_plugins._outline.fitting.covariance import image_directions
from measure_plugins._outline.fitting.edges import SEARCH_PX
from measure_plugins._outline.fitting.robust_cone import consensus, refine
from measure_plugins._outline.fitting.scan import Look, Search, View
from measure_plugins._outline.sampling.rays import CLEAR

_CONSENSUS_TRIALS = 60
_CONSENSUS_GATE_PX = 1.2
_FIRST_GATE_PX = 2.5
_FEWEST_EDGES = 6
INLIER = 0.1
"""Robust weight above which a ray agrees with a cone."""


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
        agreeing: number of rays whose edge agrees with the cone; 0 if no cone was found.
        share: of the rays that should show an edge, see `agreeing_share`.
        scatter_px: robust scatter of the edges about the cone.
    """

    axis: Floats
    half_angle: float
    center_px: Floats
    radius_px: float
    covariance_px: Floats
    points_px: Floats
    sd_px: Floats
    agreeing: int
    share: float
    scatter_px: float


class Fit(NamedTuple):
    """See `cone_fit.refine`; `scale` is infinite where there is no cone."""

    solution: Floats
    normal: Floats
    weights: Floats
    scale: float


@compiled
def reach_px(view: View, search: Search) -> float:
    """How far to search, px: not so far that the ball's other side would be met."""
    return min(max(search.reach_px, SEARCH_PX), 0.3 * search.half_angle * view.lens[0])


@compiled
def fit_look(look: Look, growth: tuple[float, float], first: bool) -> Fit:
    """The robust cone through one look's edges."""
    if np.sum(look.use) < _FEWEST_EDGES:
        return Fit(np.zeros(3), np.zeros((3, 3)), look.use, np.inf)
    start, gate = np.zeros(3), SEARCH_PX
    shifts, sd = look.edges.shifts, look.edges.sd
    if first:
        start = consensus(shifts, look.rays.around, look.use, _CONSENSUS_GATE_PX, _CONSENSUS_TRIALS)
        gate = _FIRST_GATE_PX
    solution, normal, weights, scale = refine(
        shifts, look.rays.around, sd, look.use, start, gate, growth
    )
    return Fit(solution, normal, weights, scale)


@compiled
def moved(fit: Fit) -> float:
    """How far a fit's axis is from where it was looked for, px along the axis that is off more."""
    return max(abs(fit.solution[0]), abs(fit.solution[1]))


@compiled
def agreeing_share(look: Look, fit: Fit) -> float:
    """Share of the rays that should show an edge whose edges lie on one outline.

    Those are the rays with nothing in their way and unlike colours at their ends, and those with
    nothing in their way outside which the ball's own colour goes on.
    """
    inliers = np.nonzero(fit.weights > INLIER)[0]
    return len(inliers) / max(np.sum(look.clear) + _overflow(look, inliers), 1.0)


@compiled
def residuals(look: Look, fit: Fit, least: float) -> tuple[Floats, Floats]:
    """What a fit leaves of edges with robust weights above `least`; nothing of the others.

    Returns:
        Their weights (n,) in the fit, px^-2, and residuals (n,), px; both 0 for the others.
    """
    weights, off = np.zeros(len(fit.weights)), np.zeros(len(fit.weights))
    for i in range(len(off)):
        if fit.weights[i] > least:
            x, y = look.rays.around[i]
            along = x * fit.solution[0] + y * fit.solution[1]
            off[i] = look.edges.shifts[i] - along - fit.solution[2]
            weights[i] = fit.weights[i] / (look.edges.sd[i] * fit.scale) ** 2
    return weights, off


@compiled
def turned(look: Look, fit: Fit) -> Floats:
    """The axis (3,) that a fit has found."""
    turn_by = fit.solution[0] * look.frame[0] + fit.solution[1] * look.frame[1]
    axis = look.frame[2] + turn_by / np.mean(look.scale)
    return axis / np.sqrt(np.sum(axis * axis))


@compiled
def no_outline(search: Search) -> Outline:
    """What is measured where nothing is found."""
    none = np.empty(0)
    return Outline(
        search.axis, 0.0, np.zeros(2), 0.0, np.zeros((2, 2)), none.reshape(0, 2), none, 0, 0.0, 0.0
    )


@compiled
def outline_of(
    view: View,
    look: Look,
    half_angle: float,
    fit: Fit,
    share: float,
    spread: Floats,
    wider: float,
) -> Outline:
    """The outline that a look's fit has found.

    Args:
        view: the picture.
        look: the last look.
        half_angle: that it was cast about, rad.
        fit: of its edges.
        share: of the rays that should show an edge whose edges agree with the fit.
        spread: covariance (2, 2) in px^2 of the axis along e1 and e2.
        wider: factor by which the edges are known less well than they and the fit say.
    """
    px, axis = np.mean(look.scale), turned(look, fit)
    center = np.array(to_pixel(axis[0], axis[1], axis[2], view.lens))
    inliers = np.nonzero(fit.weights > INLIER)[0]
    points, sd = np.empty((len(inliers), 2)), np.empty(len(inliers))
    for k, i in enumerate(inliers):
        s = look.edges.shifts[i]
        points[k, 0] = look.rays.points[i, 0] + s * look.rays.normals[i, 0]
        points[k, 1] = look.rays.points[i, 1] + s * look.rays.normals[i, 1]
        sd[k] = look.edges.sd[i] * max(fit.scale, 1.0) * wider
    total = 0.0
    for ray in range(len(look.rays.points)):
        right, down = look.rays.points[ray, 0] - center[0], look.rays.points[ray, 1] - center[1]
        total += np.sqrt(right * right + down * down)
    radius = fit.solution[2] + total / len(look.rays.points)
    to_image = image_directions(look.frame, view.lens) / px
    return Outline(
        axis,
        half_angle + fit.solution[2] / px,
        center,
        radius,
        _carried(to_image, spread),
        points,
        sd,
        len(inliers),
        share,
        fit.scale * nearly_kth(look.edges.sd[inliers], len(sd) // 2),
    )


@compiled
def _carried(matrix: Floats, spread: Floats) -> Floats:
    """Covariance (2, 2) of what a matrix (2, 2) makes of something of covariance `spread`."""
    out = np.zeros((2, 2))
    for a in range(2):
        for b in range(2):
            for c in range(2):
                for d in range(2):
                    out[a, b] += matrix[a, c] * spread[c, d] * matrix[b, d]
    return out


@compiled
def _overflow(look: Look, inliers: Ints) -> int:
    """Rays without an edge whose outside looks like the ball, not like what is round it."""
    if len(inliers) == 0:
        return 0
    inside, outside = look.edges.inside, look.edges.outside
    ball, ground, per = np.zeros(3), np.zeros(3), 1 / len(inliers)
    for c in range(3):
        for i in inliers:
            ball[c] += inside[c, i] * per
            ground[c] += outside[c, i] * per
    count = 0
    for i in range(len(look.clear)):
        if look.rays.status[i] == CLEAR and look.clear[i] == 0:
            nearer_ball = 0.0
            for c in range(3):
                nearer_ball += (outside[c, i] - ground[c]) ** 2 - (outside[c, i] - ball[c]) ** 2
            count += int(nearer_ball > 0)
    return count
