"""One ball's outline in one picture: cast rays, find edges, fit the cone; and again, about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Bytes, Floats
from measure_plugins._edges.cone_fit import consensus, refine
from measure_plugins._edges.corrected import corrected_edges
from measure_plugins._edges.crossing import crossings, levels
from measure_plugins._edges.lens import to_pixel
from measure_plugins._edges.rays import FREE, cast_rays, frame_about, sample, ways

INSIDE_PX = (-7.0, -3.0)
"""Where the colour inside is taken: clear of the blurred edge, near enough to have its shade."""
OUTSIDE_PX = (3.0, 6.5)
"""Where the colour outside is taken."""
_STEP_PX = 0.5
_CONSENSUS_TRIALS = 60
_CONSENSUS_GATE_PX = 1.2
_FIRST_GATE_PX = 2.5
_LAST_SEARCH_PX = 3.0
_BLOCKS = 12
_LIGHT_PER_VALUE = 0.3
"""Slope of tone curves in the shade, where contrast is scarce."""
_TURNS = 8
_FEWEST_EDGES = 6
_ROUGHLY_SETTLED_PX = 0.5
_SETTLED_PX = 0.1
"""Corrected edges are looked at again until the axis moves less: the prediction, fitted at a place
that is off, takes up part of the error. Before the correction half a pixel will do."""
_GROWTH_UNKNOWN = (0.0, 1e3)
_GROWTH_SEEN = (-0.5, 0.5)
_GROWTH_CORRECTED = (0.0, 0.3)
"""Mean and sd in px by which an outline shows larger than one predicted from a known distance:
nothing known; diffuse light fades at grazing angles, so a ball's edge lies inside its outline; and
with that taken off."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture with all that is needed to look at it: pixels, tone table and lens row."""

    pixels: Bytes
    table: Floats
    lens: Floats


@dataclass(frozen=True, eq=False)
class Search:
    """How to look for one outline.

    Attributes:
        axis: (3,) predicted unit direction of the ball's centre in the camera frame.
        half_angle: predicted half angle of its cone, rad.
        nearer: (k, 4) unit axes and half angles of nearer balls.
        reach_px: how far the outline may be from the prediction.
        distance_known: whether `half_angle` is from a known distance, not from the picture.
        rays: number of rays.
        min_contrast: least difference of inside and outside, in picture values from 0 to 1.
        margin_px: distance to keep from nearer balls.
    """

    axis: Floats
    half_angle: float
    nearer: Floats
    reach_px: float
    distance_known: bool
    rays: int
    min_contrast: float
    margin_px: float


@dataclass(frozen=True, eq=False)
class Outline:
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
        agreeing: number of rays whose edge agrees with the cone.
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


@dataclass(frozen=True, eq=False)
class _Pass:
    frame: Floats
    points: Floats
    normals: Floats
    scale: Floats
    around: Floats
    shifts: Floats
    sd: Floats
    use: Floats
    clear: Bools
    free: Bools
    inside: Floats
    outside: Floats


class _Fit(NamedTuple):
    """See `cone_fit.refine`."""

    solution: Floats
    normal: Floats
    weights: Floats
    scale: float


def measure_outline(view: View, search: Search) -> Outline | None:
    """Measure one outline near its prediction.

    Returns:
        The outline, or None if too few edges agree on one.
    """
    axis, half_angle = search.axis, search.half_angle
    reach = min(max(search.reach_px, _LAST_SEARCH_PX), 0.3 * half_angle * view.lens[0])
    for turn in range(_TURNS):
        near = reach <= _LAST_SEARCH_PX
        corrected = near and search.distance_known
        if corrected:
            rays = _look_corrected(view, search, axis, half_angle, reach)
        else:
            rays = _look(view, search, axis, half_angle, reach)
        fit = _fit(rays, search.distance_known, corrected, turn == 0 or not near)
        if fit is None:
            return None
        moved = float(np.max(np.abs(fit.solution[:2])))
        if near and moved < (_SETTLED_PX if corrected else _ROUGHLY_SETTLED_PX):
            return _outline(view, rays, half_angle, fit)
        px = float(np.mean(rays.scale))
        turn_by = fit.solution[0] * rays.frame[0] + fit.solution[1] * rays.frame[1]
        axis = rays.frame[2] + turn_by / px
        axis = axis / np.linalg.norm(axis)
        if not search.distance_known:
            half_angle += fit.solution[2] / px
        reach = _LAST_SEARCH_PX
    return None


def _fit(rays: _Pass, distance_known: bool, corrected: bool, first: bool) -> _Fit | None:
    """The robust cone through one look's edges."""
    if np.count_nonzero(rays.use) < _FEWEST_EDGES:
        return None
    growth = _GROWTH_UNKNOWN
    if distance_known:
        growth = _GROWTH_CORRECTED if corrected else _GROWTH_SEEN
    start, gate = np.zeros(3), _LAST_SEARCH_PX
    if first:
        start = consensus(rays.shifts, rays.around, rays.use, _CONSENSUS_GATE_PX, _CONSENSUS_TRIALS)
        gate = _FIRST_GATE_PX
    fit = _Fit(*refine(rays.shifts, rays.around, rays.sd, rays.use, start, gate, growth))
    return fit if np.isfinite(fit.scale) else None


def _look(view: View, search: Search, axis: Floats, half_angle: float, reach: float) -> _Pass:
    """Cast rays across the predicted outline and find the edges along them."""
    wider = max(reach - _LAST_SEARCH_PX, 0.0)
    inside = (INSIDE_PX[0] - wider, INSIDE_PX[1] - wider)
    outside = (OUTSIDE_PX[0] + wider, OUTSIDE_PX[1] + wider)
    steps = np.arange(inside[0], outside[1] + 1e-9, _STEP_PX)
    frame = frame_about(axis)
    points, normals, scale, around = cast_rays(frame, half_angle, search.rays, view.lens)
    free = ways(
        frame,
        half_angle,
        scale,
        around,
        search.nearer,
        (inside[0], outside[1]),
        search.margin_px,
    )
    profiles = sample(view.pixels, view.table, points, normals, steps, free)
    within, without = levels(profiles, steps, inside, outside)
    shifts, sd, contrast = crossings(profiles, steps, within, without, inside, reach, False)
    clear = (free == FREE) & (contrast >= _LIGHT_PER_VALUE * search.min_contrast)
    use = (clear & np.isfinite(shifts)).astype(np.float64)
    return _Pass(
        frame,
        points,
        normals,
        scale,
        around,
        shifts,
        sd,
        use,
        clear,
        free == FREE,
        within,
        without,
    )


def _look_corrected(
    view: View, search: Search, axis: Floats, half_angle: float, reach: float
) -> _Pass:
    """The same with the edge finder's own error taken off."""
    frame = frame_about(axis)
    points, normals, scale, around = cast_rays(frame, half_angle, search.rays, view.lens)
    span = (INSIDE_PX[0], OUTSIDE_PX[1])
    free = ways(frame, half_angle, scale, around, search.nearer, span, search.margin_px)
    edges = corrected_edges(
        view.pixels,
        view.table,
        points,
        normals,
        around,
        free,
        half_angle,
        float(np.mean(scale)),
        search.min_contrast,
    )
    clear = (free == FREE) & edges.clear
    good = clear & np.isfinite(edges.shifts) & (np.abs(edges.shifts) < reach)
    return _Pass(
        frame,
        points,
        normals,
        scale,
        around,
        edges.shifts,
        edges.sd,
        good.astype(np.float64),
        clear,
        free == FREE,
        edges.inside,
        edges.outside,
    )


def _outline(view: View, rays: _Pass, half_angle: float, fit: _Fit) -> Outline:
    solution, normal, weights, scale = fit
    px = float(np.mean(rays.scale))
    axis = rays.frame[2] + (solution[0] * rays.frame[0] + solution[1] * rays.frame[1]) / px
    axis = axis / np.linalg.norm(axis)
    center = np.array(to_pixel(axis[0], axis[1], axis[2], view.lens))
    inliers = weights > 0.1
    to_image = _image_directions(rays.frame, view.lens) / px
    residuals = np.where(inliers, rays.shifts - rays.around @ solution[:2] - solution[2], 0.0)
    growth = _correlation(residuals / (rays.sd * scale), inliers)
    covariance = growth * np.linalg.inv(normal)[:2, :2]
    shift = rays.shifts[inliers, None] * rays.normals[inliers]
    return Outline(
        axis=axis,
        half_angle=half_angle + solution[2] / px,
        center_px=center,
        radius_px=float(np.mean(np.linalg.norm(rays.points - center, axis=1)) + solution[2]),
        covariance_px=to_image @ covariance @ to_image.T,
        points_px=rays.points[inliers] + shift,
        sd_px=rays.sd[inliers] * max(scale, 1.0),
        clear=int(np.count_nonzero(rays.clear)),
        overflow=_overflow(rays, inliers),
        agreeing=int(np.count_nonzero(inliers)),
        scatter_px=float(scale * np.median(rays.sd[inliers])),
    )


def _overflow(rays: _Pass, inliers: Bools) -> int:
    """Rays without an edge whose outside looks like the ball, not like what is round it."""
    if not np.any(inliers):
        return 0
    ball, ground = np.mean(rays.inside[inliers], axis=0), np.mean(rays.outside[inliers], axis=0)
    open_ended = rays.free & ~rays.clear
    to_ball = np.linalg.norm(rays.outside - ball, axis=1)
    to_ground = np.linalg.norm(rays.outside - ground, axis=1)
    return int(np.count_nonzero(open_ended & (to_ball < to_ground)))


def _image_directions(frame: Floats, lens: Floats) -> Floats:
    """Image (2, 2) of a turn by one radian of the axis along e1 and e2: columns in px."""
    h = 1e-6
    ends = [frame[2] + sign * h * frame[k] for k in (0, 1) for sign in (1, -1)]
    pixels = np.array([to_pixel(e[0], e[1], e[2], lens) for e in ends])
    return np.stack([pixels[0] - pixels[1], pixels[2] - pixels[3]], axis=1) / (2 * h)


def _correlation(standard: Floats, inliers: Bools) -> float:
    """How much wider than for independent rays a mean over the outline scatters (batch means).

    Neighbouring rays share pixels, shading and what stands behind: their errors go together.
    """
    sums, counts = [], []
    for block, chosen in zip(
        np.array_split(standard, _BLOCKS), np.array_split(inliers, _BLOCKS), strict=True
    ):
        if np.count_nonzero(chosen) > 1:
            sums.append(float(np.sum(block[chosen])))
            counts.append(int(np.count_nonzero(chosen)))
    if len(sums) < 4:
        return 4.0
    return max(1.0, float(np.sum(np.square(sums)) / np.sum(counts)))
