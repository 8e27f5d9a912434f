"""All balls expected in one picture, each measured in one call of compiled code.

Outlines are scanned repeatedly: with corrected edges where the ball's size is known, else without.

The prediction is fitted to the picture where the outline is assumed to be, and takes up part of its
displacement. How much depends on the light on the ball, on its size and on its reflections, and
hardly changes from picture to picture: it is measured once, and each scan's result multiplied by
the inverse. See docs/explanation/outline.md, formula 16.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled
from measure.geometry.kernels import inverse
from measure.limits import TINY
from measure.model.lens import bearing
from measure_plugins._outline.cone_fit import (
    MAX_RESIDUAL_PX,
    center_covariance,
    piecewise_covariance,
)
from measure_plugins._outline.edges import SEARCH_PX
from measure_plugins._outline.rays import frame_about, radius_px
from measure_plugins._outline.reflectance import RadialTables
from measure_plugins._outline.scan import (
    COLOR_SD_PX,
    INLIER,
    CameraImage,
    ConeFit,
    EdgeScan,
    Outline,
    OutlineSearch,
    agreeing_share,
    ambient_light,
    axis_shift_px,
    color_share,
    corrected_axis,
    fit_scan,
    no_outline,
    outline_of,
    reach_px,
    residuals,
    scan_color,
    scan_half_level,
    scan_with_model,
)

_MAX_ITERATIONS = 8
_CONVERGED_PX, _CONVERGED_SD, _MAX_MOVE_PX = 0.3, 3.0, 0.5
"""Corrected edges have converged when the axis moves less than the first, or than so many of its
standard deviations and the last: each iteration leaves about a twentieth of the distance, which is
little against the scatter of the edges."""
_CONVINCING_SHARE = 2 / 3
"""Share of agreeing edges (see `agreeing_share`) above which no wider scan is made."""
_GROWTH_SEEN = (-0.5, 0.5)
"""Prior mean and sd in px of the radius of half-level crossings minus the one predicted by
distance: diffuse light fades at grazing angles, so the crossing lies inside the outline."""
_ANY_GROWTH = (0.0, 1e3)  # The same prior where the size is not known
_CIRCLE_REACH = 0.2
"""How far an outline may be from a circle found by colour, as a share of its radius."""
FROM_OUTSIDE = 1.12
"""Half angle from which an outline is approached, per that of the circle: reflections and the edge
of the shade lie inside an outline, and keep scans from there. Of 1, 1.06, 1.12, and 1.2, this one
finds most true outlines and fewest false ones on path-traced recordings."""
FROM_INSIDE = 0.95
"""The same for the border of a ball's colour, which balls that touch make too wide."""
_CHANCE_SHARE = np.sqrt(1 - np.sqrt(INLIER)) * MAX_RESIDUAL_PX / SEARCH_PX
"""Share of edges that lie anywhere, not on the ball's outline, that agree with it by chance."""
_MIN_INFORMATIVE = 0.05


@compiled
def measure_known_size(view: CameraImage, search: OutlineSearch, tables: RadialTables) -> Outline:
    """Measure an outline of known size by corrected edges, from its prediction if that converges.

    Wide scans show much more than the outline and are often further off than the prediction: one is
    made only where the corrected edges about the prediction do not agree.
    """
    near = _iterate_corrected(view, search, tables, search.axis)
    reach = reach_px(view, search)
    if reach <= SEARCH_PX or near.share >= _CONVINCING_SHARE:
        return near
    scan = scan_half_level(view, search, search.axis, search.half_angle, reach)
    fit = fit_scan(scan, _GROWTH_SEEN, True)
    if not np.isfinite(fit.scale):
        return near
    far = _iterate_corrected(view, search, tables, corrected_axis(scan, fit))
    return far if far.agreeing > near.agreeing else near


@compiled
def _iterate_corrected(
    view: CameraImage, search: OutlineSearch, tables: RadialTables, axis: Floats
) -> Outline:
    """The outline that scans with the model converge to from `axis`, the predicted or another."""
    ambient = ambient_light(view, search, axis, tables)
    before, predicted = np.zeros(2), bool(np.all(axis == search.axis))
    for turn in range(_MAX_ITERATIONS):
        scan = scan_with_model(view, search, axis, search.half_angle, tables, ambient)
        fit = fit_scan(scan, CORRECTED_GROWTH, predicted and turn == 0)
        if not np.isfinite(fit.scale):
            break
        apply_step_gain(scan, fit, search.step_gain)
        if axis_shift_px(fit) < _MAX_MOVE_PX:
            weights, off = residuals(scan, fit, INLIER)
            spread = center_covariance(scan.rays.around, weights, off, fit.normal)
            if _is_converged(fit, spread):
                share = agreeing_share(scan, fit)
                return outline_of(view, scan, fit, share, spread, 1.0)
        step = fit.solution[:2]
        if np.sum(step * before) < 0:
            step *= 0.5  # else the iteration may oscillate
        before = step
        axis = corrected_axis(scan, fit)
    return no_outline()


@compiled
def _is_converged(fit: ConeFit, spread: Floats) -> bool:
    """Whether the last step is small against the axis' covariance `spread` (2, 2), px^2."""
    sd = np.sqrt((spread[0, 0] + spread[1, 1]) / 2)
    return axis_shift_px(fit) < max(_CONVERGED_SD * sd, _CONVERGED_PX)


@compiled
def search_about_circle(
    view: CameraImage, circle: Floats, larger: float, rays: int, min_contrast: float
) -> OutlineSearch:
    """The search for an outline from a circle x, y, r found by colour, so much `larger`."""
    axis = bearing(circle[:2], view.lens)
    half_angle = 2 * circle[2] / (view.lens[0] + view.lens[3])
    half_angle *= larger * circle[2] / radius_px(axis, half_angle, view.lens)
    far = _CIRCLE_REACH * circle[2]
    return unoccluded_search(axis, half_angle, far, rays, min_contrast, 0.0)


@compiled
def unoccluded_search(
    axis: Floats, half_angle: float, far: float, rays: int, min_contrast: float, margin_px: float
) -> OutlineSearch:
    """The search for an outline of unknown size without a known ball before it."""
    none, unit = np.empty((0, 4)), np.eye(2)
    return OutlineSearch(
        axis, half_angle, none, none, far, rays, min_contrast, margin_px, np.inf, unit
    )


@compiled
def measure_unknown_size(
    view: CameraImage, search: OutlineSearch, give_up_share: float, colors: Bytes, bit: int
) -> Outline:
    """Measure an outline of unknown size by its half-level crossings, or by where its colour ends.

    Args:
        give_up_share: share of agreeing edges in a narrow scan below which no further one is made.
        bit: of the ball's colour there; 0 for half-level crossings.
    """
    axis, half_angle, reach = search.axis, search.half_angle, reach_px(view, search)
    for turn in range(_MAX_ITERATIONS):
        if bit:
            scan = scan_color(view, axis, half_angle, search.rays, reach, colors, bit)
        else:
            scan = scan_half_level(view, search, axis, half_angle, reach)
        near = reach <= SEARCH_PX
        fit = fit_scan(scan, _ANY_GROWTH, (turn == 0 and search.reach_px > 0) or not near)
        if not np.isfinite(fit.scale):
            break
        if near and axis_shift_px(fit) < _MAX_MOVE_PX:
            share = agreeing_share(scan, fit)
            spread, wider = _chance_corrected(scan, fit, share)
            if bit:
                spread += COLOR_SD_PX**2 * np.eye(2)
            return outline_of(view, scan, fit, share, spread, wider)
        if turn > 0 and agreeing_share(scan, fit) < give_up_share:
            break
        axis = corrected_axis(scan, fit)
        half_angle += fit.solution[2] / np.mean(scan.scale)
        reach = SEARCH_PX
    return no_outline()


@compiled
def _chance_corrected(scan: EdgeScan, fit: ConeFit, share: float) -> tuple[Floats, float]:
    """Covariance of an axis by edges that are not corrected and may belong to another object.

    Some edges agree with the outline by chance: only the agreement beyond that counts (Cohen 1960).
    """
    informative = max((share - _CHANCE_SHARE) / (1 - _CHANCE_SHARE), _MIN_INFORMATIVE)
    weights, off = residuals(scan, fit, 0.0)
    spread = piecewise_covariance(scan.rays.around, weights, off, fit.normal)
    wider = np.sqrt(np.trace(spread) / np.trace(inverse(fit.normal)[:2, :2])) / informative
    return spread / informative**2, wider


CORRECTED_GROWTH = (0.0, 0.3)
"""Prior mean and sd in px of the radius of corrected edges minus the one predicted by distance."""
_OFFSET_PX = 0.3
_MAX_EXCESS = 1.0
"""Limit of the gain minus the unit matrix (Frobenius norm), where the response is weak."""


@compiled
def apply_step_gain(scan: EdgeScan, fit: ConeFit, step_gain: Floats) -> None:
    """Multiply the shift of a fit's axis by the gain, and move the scan's edges along."""
    found = fit.solution[:2].copy()
    for a in range(2):
        fit.solution[a] = step_gain[a, 0] * found[0] + step_gain[a, 1] * found[1]
    more = fit.solution[:2] - found
    around = scan.rays.around
    for i in range(len(around)):
        scan.edges.shifts[i] += around[i, 0] * more[0] + around[i, 1] * more[1]


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
    if not np.linalg.det(response) > TINY:
        return np.eye(2)
    more = np.linalg.inv(response) - np.eye(2)
    return np.eye(2) + more * min(1.0, _MAX_EXCESS / (float(np.linalg.norm(more)) + 1e-12))


_BEYOND_DOUBT = 0.8
"""Share of agreeing edges above which an outline is not compared with that of the colour."""
_FAR_APART_PX = 12.0  # Distance of the fewer rays about a circle above which more are cast
_COMPLETE = 0.5
"""Share of a circle seen times share of its inside filled that convinces by colour alone."""


class BallSearch(NamedTuple):
    """Where a ball is searched for."""

    outline: OutlineSearch
    tables: RadialTables | None  # what its size makes it show; None: edges are not corrected
    bit: int  # of its colour in the table of colours


class Measured(NamedTuple):
    """What was found of a ball."""

    outline: Outline
    color_share: float  # of samples inside the outline that have the ball's colour
    rays: int  # cast across it


def cones_of(centers: Floats, radii: Floats, lens: Floats) -> Floats:
    """Outlines (k, 6) of balls (mm, camera frame).

    Unit axis, half angle in rad, the ball's distance in mm, and the mean radius in px.
    """
    distances = np.sqrt(np.sum(centers**2, axis=1))
    axes, half_angles = centers / distances[:, None], np.arcsin(radii / distances)
    radii_px = [radius_px(*one, lens) for one in zip(axes, half_angles, strict=True)]
    return np.column_stack([axes, half_angles, distances, radii_px])


def measure_balls(
    view: CameraImage, searches: Iterable[BallSearch], give_up_share: float, colors: Bytes
) -> list[Measured]:
    """Measure every expected ball."""
    found = []
    for search, tables, bit in searches:
        if tables is not None:
            outline = measure_known_size(view, search, tables)
        else:
            outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        found.append(_with_color(view, outline, search.rays, colors, bit))
    return found


def measure_circles(
    view: CameraImage,
    circles: Floats,
    bits: Ints,
    rays: tuple[int, int],
    min_contrast: float,
    give_up_share: float,
    colors: Bytes,
) -> list[Measured]:
    """Measure the outlines near rough circles, of unknown size and behind no known ball.

    Where too few edges agree, as on textured balls or in front of texture, the colour that has
    found a circle, if much of it, decides where it ends.

    Args:
        circles: (k, 6) centre x, y and radius, px, shares of the circle seen and of its inside
            filled, and the number of the bit that has found it.
        bits: (k,) of their colours in the table of colours.
        rays: cast across each outline, and how many across large ones.
    """
    found = []
    for circle, bit in zip(circles, bits.tolist(), strict=True):
        some = rays[int(2 * np.pi * circle[2] > _FAR_APART_PX * rays[0])]
        search = search_about_circle(view, circle, FROM_OUTSIDE, some, min_contrast)
        outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        if circle[3] * circle[4] >= _COMPLETE and outline.share < _BEYOND_DOUBT:
            search = search_about_circle(view, circle, FROM_INSIDE, some, min_contrast)
            of_circle = 1 << int(circle[5])
            by_color = measure_unknown_size(view, search, give_up_share, colors, of_circle)
            if by_color.share > outline.share:
                outline = by_color
        found.append(_with_color(view, outline, some, colors, bit))
    return found


def _with_color(
    view: CameraImage, outline: Outline, rays: int, colors: Bytes, bit: int
) -> Measured:
    if outline.agreeing == 0:
        return Measured(outline, 0.0, rays)
    share = color_share(view.pixels, colors, bit, outline.center_px, outline.points_px)
    return Measured(outline, share, rays)
