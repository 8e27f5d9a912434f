"""The cone fitted to the edges of one scan, and the outline it gives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.model.lens import to_pixel
from measure_plugins._outline.fitting.covariance import image_directions
from measure_plugins._outline.fitting.edges import SEARCH_PX
from measure_plugins._outline.fitting.robust_cone import consensus, refine
from measure_plugins._outline.fitting.scan import CameraImage, EdgeScan, OutlineSearch
from measure_plugins._outline.sampling.rays import CLEAR

_CONSENSUS_TRIALS = 60
_CONSENSUS_GATE_PX = 1.2
_FIRST_GATE_PX = 2.5
_MIN_EDGES = 6
INLIER = 0.1
"""Robust weight above which a ray agrees with a cone."""


class Outline(NamedTuple):
    """A measured outline."""

    center_px: Floats  # (2,) image of the sphere's centre
    radius_px: float
    covariance_px: Floats  # (2, 2) of `center_px`
    points_px: Floats  # (n, 2) edge points that agree with the cone
    sd_px: Floats  # (n,) their standard deviations along the normal
    agreeing: int  # number of rays whose edge agrees with the cone; 0 if no cone was found
    share: float  # of the rays that should show an edge, see `agreeing_share`


class Fit(NamedTuple):
    """See `robust_cone.refine`; `scale` is infinite where there is no cone."""

    solution: Floats
    normal: Floats
    weights: Floats
    scale: float


@compiled
def reach_px(view: CameraImage, search: OutlineSearch) -> float:
    """How far to search, px; less than the distance to the ball's other side."""
    return min(max(search.reach_px, SEARCH_PX), 0.3 * search.half_angle * view.lens[0])


@compiled
def fit_scan(scan: EdgeScan, growth: tuple[float, float], first: bool) -> Fit:
    """The robust cone through the edges of a scan; by consensus first, if it is the `first` one."""
    if np.sum(scan.use) < _MIN_EDGES:
        return Fit(np.zeros(3), np.zeros((3, 3)), scan.use, np.inf)
    start, gate = np.zeros(3), SEARCH_PX
    shifts, sd = scan.edges.shifts, scan.edges.sd
    if first:
        start = consensus(shifts, scan.rays.around, scan.use, _CONSENSUS_GATE_PX, _CONSENSUS_TRIALS)
        gate = _FIRST_GATE_PX
    solution, normal, weights, scale = refine(
        shifts, scan.rays.around, sd, scan.use, start, gate, growth
    )
    return Fit(solution, normal, weights, scale)


@compiled
def axis_shift_px(fit: Fit) -> float:
    """How far a fit moves the axis, px along e1 or e2, whichever is more."""
    return max(abs(fit.solution[0]), abs(fit.solution[1]))


@compiled
def agreeing_share(scan: EdgeScan, fit: Fit) -> float:
    """Share of the rays that should show an edge whose edges lie on one outline.

    Those are clear rays with contrast, and clear rays without, outside which the ball's colour
    continues.
    """
    inliers = np.nonzero(fit.weights > INLIER)[0]
    return len(inliers) / max(np.sum(scan.clear) + _overflow(scan, inliers), 1.0)


@compiled
def residuals(scan: EdgeScan, fit: Fit, least: float) -> tuple[Floats, Floats]:
    """Weights (n,), px^-2, and residuals (n,), px, of edges weighed above `least`; 0 for others."""
    weights, off = np.zeros(len(fit.weights)), np.zeros(len(fit.weights))
    for i in range(len(off)):
        if fit.weights[i] > least:
            x, y = scan.rays.around[i]
            along = x * fit.solution[0] + y * fit.solution[1]
            off[i] = scan.edges.shifts[i] - along - fit.solution[2]
            weights[i] = fit.weights[i] / (scan.edges.sd[i] * fit.scale) ** 2
    return weights, off


@compiled
def corrected_axis(scan: EdgeScan, fit: Fit) -> Floats:
    """The axis (3,) that a fit has found."""
    turn_by = fit.solution[0] * scan.frame[0] + fit.solution[1] * scan.frame[1]
    axis = scan.frame[2] + turn_by / np.mean(scan.scale)
    return axis / np.sqrt(np.sum(axis * axis))


@compiled
def no_outline() -> Outline:
    """Without edges: none was found."""
    none = np.empty(0)
    return Outline(np.zeros(2), 0.0, np.zeros((2, 2)), none.reshape(0, 2), none, 0, 0.0)


@compiled
def outline_of(
    view: CameraImage, scan: EdgeScan, fit: Fit, share: float, spread: Floats, wider: float
) -> Outline:
    """The outline that a scan's fit gives.

    Args:
        share: of the rays that should show an edge whose edges agree with the fit.
        spread: covariance (2, 2) in px^2 of the axis along e1 and e2.
        wider: factor by which the edges are less certain than their own sd and the scale of the
            fit.
    """
    px, axis = np.mean(scan.scale), corrected_axis(scan, fit)
    center = np.array(to_pixel(axis[0], axis[1], axis[2], view.lens))
    inliers = np.nonzero(fit.weights > INLIER)[0]
    points, sd = np.empty((len(inliers), 2)), np.empty(len(inliers))
    for k, i in enumerate(inliers):
        s = scan.edges.shifts[i]
        points[k, 0] = scan.rays.points[i, 0] + s * scan.rays.normals[i, 0]
        points[k, 1] = scan.rays.points[i, 1] + s * scan.rays.normals[i, 1]
        sd[k] = scan.edges.sd[i] * max(fit.scale, 1.0) * wider
    total = 0.0
    for ray in range(len(scan.rays.points)):
        right, down = scan.rays.points[ray, 0] - center[0], scan.rays.points[ray, 1] - center[1]
        total += np.sqrt(right * right + down * down)
    radius = fit.solution[2] + total / len(scan.rays.points)
    to_image = image_directions(scan.frame, view.lens) / px
    covariance = _carried(to_image, spread)
    return Outline(center, radius, covariance, points, sd, len(inliers), share)


@compiled
def _carried(matrix: Floats, spread: Floats) -> Floats:
    """Covariance (2, 2) of `matrix` (2, 2) times a vector of covariance `spread`."""
    out = np.zeros((2, 2))
    for a in range(2):
        for b in range(2):
            for c in range(2):
                for d in range(2):
                    out[a, b] += matrix[a, c] * spread[c, d] * matrix[b, d]
    return out


@compiled
def _overflow(scan: EdgeScan, inliers: Ints) -> int:
    """Clear rays without contrast whose outside has the ball's colour, not the background's."""
    if len(inliers) == 0:
        return 0
    inside, outside = scan.edges.inside, scan.edges.outside
    ball, ground, per = np.zeros(3), np.zeros(3), 1 / len(inliers)
    for c in range(3):
        for i in inliers:
            ball[c] += inside[c, i] * per
            ground[c] += outside[c, i] * per
    count = 0
    for i in range(len(scan.clear)):
        if scan.rays.status[i] == CLEAR and scan.clear[i] == 0:
            nearer_ball = 0.0
            for c in range(3):
                nearer_ball += (outside[c, i] - ground[c]) ** 2 - (outside[c, i] - ball[c]) ** 2
            count += int(nearer_ball > 0)
    return count
