"""One scan of an outline: rays across its prediction, edges along them, the cone through these.

Edges are where the picture passes half-way between inside and outside, or where a colour ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats, Ints, Singles
from measure.compiling import compiled
from measure.model.lens import to_pixel
from measure_plugins._outline.appearance import Ambient, ball_reflection_shares
from measure_plugins._outline.cone_fit import consensus, image_directions, refine
from measure_plugins._outline.edges import (
    INSIDE_PX,
    OUTSIDE_PX,
    SEARCH_PX,
    Edges,
    PredictionInputs,
    corrected_edges,
    find_edge_pairs,
)
from measure_plugins._outline.rays import (
    CLEAR,
    OUT_OF_IMAGE,
    RaySet,
    Statuses,
    angles_around,
    cast_rays,
    crossings,
    frame_about,
    levels,
    mark_occluded,
    middle_angles,
    project,
    sample,
    sample_nearest,
    uncertainty,
)
from measure_plugins._outline.reflectance import RadialTables, lights_about, shade_by_lights

STEP_PX, _WHOLE_PX = 0.5, 1.0
"""Distance of samples: of a narrow scan, and of a wide one, which only starts a better one."""
_LIGHT_PER_VALUE = 0.3
"""Slope of tone curves in the shade, light per picture value, where contrast is scarce."""


class CameraImage(NamedTuple):
    """A picture and how its camera shows balls."""

    pixels: Bytes  # (h, w, 3) uint8
    table: Floats  # (256,) light of each picture value
    encoding: Singles  # see `sensor.encoding`
    lens: Floats  # (14,) lens row
    point_lights: Floats  # (k, 4) in the camera frame, see `appearance.point_lights`
    correction_weight: float  # see `Appearance`


class OutlineSearch(NamedTuple):
    """Where and how one outline is searched for."""

    axis: Floats  # (3,) predicted unit direction of the ball's centre in the camera frame
    half_angle: float  # predicted half angle of its cone, rad
    nearer: Floats  # (k, 4) unit axes and half angles of nearer balls
    behind: Floats  # (k, 4) balls further away, see `balls_behind`
    reach_px: float  # how far the outline may be from the prediction
    rays: int
    min_contrast: float  # least difference of inside and outside, in picture values from 0 to 1
    margin_px: float
    distance: float  # of the ball, mm; unused where its size is not known
    step_gain: Floats  # (2, 2) see `measure_step_gain`; used for corrected edges only


class EdgeScan(NamedTuple):
    """Edges found along n rays across a predicted outline."""

    frame: Floats  # (3, 3) see `rays.frame_about`
    rays: RaySet
    scale: Floats  # (n,) px per rad along their normals
    edges: Edges
    clear: Floats  # (n,) 1 for clear rays on which inside and outside differ enough, else 0
    use: Floats  # (n,) 1 for clear rays with an edge, else 0


@compiled
def scan_half_level(
    view: CameraImage, search: OutlineSearch, axis: Floats, half_angle: float, reach_px: float
) -> EdgeScan:
    """Find the half-level crossings, in light, within `reach_px` of the prediction.

    Wide scans take the nearest pixels: interpolated, one ball of 34 in photographs lay 10 px aside.
    """
    wider = max(reach_px - SEARCH_PX, 0.0)
    inside = (INSIDE_PX[0] - wider, INSIDE_PX[1] - wider)
    outside = (OUTSIDE_PX[0] + wider, OUTSIDE_PX[1] + wider)
    step = _WHOLE_PX if wider > 0 else STEP_PX
    steps = np.arange(inside[0], outside[1] + 1e-9, step)
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, search.rays, view.lens)
    reach = (inside[0], outside[1])
    mark_occluded(rays, scale, frame, half_angle, search.nearer, reach, search.margin_px)
    if wider > 0:
        profiles = sample_nearest(view.pixels, view.table, rays, steps)
    else:
        lit = np.ones(len(steps), np.bool_)
        profiles, _ = sample(view.pixels, view.table, rays, steps, lit, len(steps))
    within, without = levels(profiles, steps, inside), levels(profiles, steps, outside)
    x, contrast = project(profiles, within, without, False)
    at, slope = crossings(x, steps, reach_px)
    sd = uncertainty(x, steps, at, slope, inside)
    lights = within.astype(np.float64), without.astype(np.float64)
    edges = Edges(at.astype(np.float64), sd, contrast, lights[0], lights[1])
    least = _LIGHT_PER_VALUE * search.min_contrast
    clear, use = _usable(edges, rays.status, least, np.inf)
    return EdgeScan(frame, rays, scale, edges, clear, use)


@compiled
def scan_with_model(
    view: CameraImage,
    search: OutlineSearch,
    axis: Floats,
    half_angle: float,
    tables: RadialTables,
    ambient: Ambient,
) -> EdgeScan:
    """Find edges corrected by the model's prediction; `ambient` as from `ambient_light`."""
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, search.rays, view.lens)
    reach = (INSIDE_PX[0], OUTSIDE_PX[1])
    mark_occluded(rays, scale, frame, half_angle, search.nearer, reach, search.margin_px)
    found = find_edge_pairs(
        PredictionInputs(view.pixels, view.table, view.encoding, rays, tables, ambient)
    )
    edges = corrected_edges(found, view.correction_weight)
    clear, use = _usable(edges, rays.status, search.min_contrast, SEARCH_PX)
    return EdgeScan(frame, rays, scale, edges, clear, use)


@compiled
def ambient_light(
    view: CameraImage, search: OutlineSearch, axis: Floats, tables: RadialTables
) -> Ambient:
    """The light on a ball, along its groups of rays, as far as it is known.

    It holds for scans a few pixels away too, because lights are far away.
    """
    frame, around = frame_about(axis), middle_angles(angles_around(search.rays))
    point_lights = lights_about(view.point_lights, frame, search.distance)
    return Ambient(
        shade_by_lights(tables.diffuse, tables.fresnel_loss[0], around, point_lights),
        ball_reflection_shares(search.behind, frame, search.half_angle, around),
    )


@compiled
def _usable(
    edges: Edges, status: Statuses, min_contrast: float, furthest_px: float
) -> tuple[Floats, Floats]:
    """Which rays (n,) have enough contrast, and which of them an edge; 1 or 0 each."""
    n = len(status)
    clear, use = np.zeros(n), np.zeros(n)
    for i in range(n):
        if status[i] == CLEAR and edges.contrast[i] >= min_contrast:
            clear[i] = 1.0
            if abs(edges.shifts[i]) < furthest_px:
                use[i] = 1.0
    return clear, use


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


class ConeFit(NamedTuple):
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
def fit_scan(scan: EdgeScan, growth: tuple[float, float], first: bool) -> ConeFit:
    """The robust cone through the edges of a scan; by consensus first, if it is the `first` one."""
    if np.sum(scan.use) < _MIN_EDGES:
        return ConeFit(np.zeros(3), np.zeros((3, 3)), scan.use, np.inf)
    start, gate = np.zeros(3), SEARCH_PX
    shifts, sd = scan.edges.shifts, scan.edges.sd
    if first:
        start = consensus(shifts, scan.rays.around, scan.use, _CONSENSUS_GATE_PX, _CONSENSUS_TRIALS)
        gate = _FIRST_GATE_PX
    solution, normal, weights, scale = refine(
        shifts, scan.rays.around, sd, scan.use, start, gate, growth
    )
    return ConeFit(solution, normal, weights, scale)


@compiled
def axis_shift_px(fit: ConeFit) -> float:
    """How far a fit moves the axis, px along e1 or e2, whichever is more."""
    return max(abs(fit.solution[0]), abs(fit.solution[1]))


@compiled
def agreeing_share(scan: EdgeScan, fit: ConeFit) -> float:
    """Share of the rays that should show an edge whose edges lie on one outline.

    Those are clear rays with contrast, and clear rays without, outside which the ball's colour
    continues.
    """
    inliers = np.nonzero(fit.weights > INLIER)[0]
    return len(inliers) / max(np.sum(scan.clear) + _overflow(scan, inliers), 1.0)


@compiled
def residuals(scan: EdgeScan, fit: ConeFit, least: float) -> tuple[Floats, Floats]:
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
def corrected_axis(scan: EdgeScan, fit: ConeFit) -> Floats:
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
    view: CameraImage, scan: EdgeScan, fit: ConeFit, share: float, spread: Floats, wider: float
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


COLOR_SD_PX = 0.5
"""Standard deviation of where a colour ends along a ray, seen in whole pixels; and of the centre
by all of them, where shade or a reflection ends the colour."""
_RINGS = (0.25, 0.5, 0.7, 0.85)
"""Radii, as shares of the outline's, at which the colour inside is sampled."""
_CUT = 2  # By how many bits picture values are cut for a table of colours


@compiled
def scan_color(
    view: CameraImage,
    axis: Floats,
    half_angle: float,
    count: int,
    reach_px: float,
    colors: Bytes,
    bit: int,
) -> EdgeScan:
    """Find where a colour ends on rays across an outline, nearest to it.

    Holes, prints, and things behind the ball that differ from it in brightness alone do not count.

    Args:
        axis: (3,) unit direction of the ball's centre in the camera frame.
        half_angle: of its cone, rad.
        colors: (64, 64, 64) bits by blue, green and red, each cut to as many levels.
    """
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, count, view.lens)
    height, width = view.pixels.shape[:2]
    at, clear, use = np.full(count, np.nan), np.zeros(count), np.zeros(count)
    for i in range(count):
        colored, s = False, -reach_px - STEP_PX
        while s < reach_px:
            s += STEP_PX
            x = round(rays.points[i, 0] + s * rays.normals[i, 0])
            y = round(rays.points[i, 1] + s * rays.normals[i, 1])
            if not (0 <= x < width and 0 <= y < height):
                rays.status[i] = OUT_OF_IMAGE
                break
            b, g, r = view.pixels[y, x]
            before, colored = colored, colors[b >> _CUT, g >> _CUT, r >> _CUT] & bit != 0
            if before and not colored and not abs(at[i]) <= abs(s - STEP_PX / 2):
                at[i] = s - STEP_PX / 2
        clear[i] = rays.status[i] == CLEAR
        use[i] = clear[i] * np.isfinite(at[i])
    dark = np.zeros((3, count))
    edges = Edges(at, np.full(count, COLOR_SD_PX), np.ones(count), dark, dark)
    return EdgeScan(frame, rays, scale, edges, clear, use)


@compiled
def color_share(pixels: Bytes, colors: Bytes, bit: int, center: Floats, points: Floats) -> float:
    """Share of the samples between the centre and edge points that have a colour.

    Args:
        pixels: (h, w, 3) uint8.
        center: (2,) px.
        points: (n, 2) px.
    """
    height, width = pixels.shape[:2]
    seen, alike = 0, 0
    for i in range(len(points)):
        for share in _RINGS:
            x = round(center[0] + share * (points[i, 0] - center[0]))
            y = round(center[1] + share * (points[i, 1] - center[1]))
            if 0 <= x < width and 0 <= y < height:
                b, g, r = pixels[y, x]
                seen += 1
                alike += colors[b >> _CUT, g >> _CUT, r >> _CUT] & bit != 0
    return alike / seen if seen else 0.0
