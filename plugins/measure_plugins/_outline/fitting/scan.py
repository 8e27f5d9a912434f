"""One scan of an outline: rays across its prediction, and the edges along them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure_plugins._outline.appearance.interreflection import ball_reflection_shares
from measure_plugins._outline.appearance.point_lights import lights_about, shade_by_lights
from measure_plugins._outline.appearance.radial_basis import RadialTables
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.appearance.sensor import Sensor
from measure_plugins._outline.fitting.edges import (
    INSIDE_PX,
    OUTSIDE_PX,
    SEARCH_PX,
    Edges,
    PredictionInputs,
    corrected_edges,
    find_edge_pairs,
)
from measure_plugins._outline.sampling.edge_crossing import crossings, levels, project, uncertainty
from measure_plugins._outline.sampling.ray_groups import middle_angles
from measure_plugins._outline.sampling.rays import (
    CLEAR,
    RaySet,
    Statuses,
    angles_around,
    cast_rays,
    frame_about,
    mark_occluded,
    sample,
    sample_nearest,
)

_STEP_PX, _WHOLE_PX = 0.5, 1.0
"""Distance of samples: of a narrow scan, and of a wide one, which only starts a better one."""
_LIGHT_PER_VALUE = 0.3
"""Slope of tone curves in the shade, light per picture value, where contrast is scarce."""


class CameraImage(NamedTuple):
    """A picture and how its camera shows balls."""

    pixels: Bytes  # (h, w, 3) uint8
    table: Floats  # (256,) light of each picture value
    sensor: Sensor
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

    Wide scans take the nearest pixels, without interpolation.
    """
    wider = max(reach_px - SEARCH_PX, 0.0)
    inside = (INSIDE_PX[0] - wider, INSIDE_PX[1] - wider)
    outside = (OUTSIDE_PX[0] + wider, OUTSIDE_PX[1] + wider)
    step = _WHOLE_PX if wider > 0 else _STEP_PX
    steps = np.arange(inside[0], outside[1] + 1e-9, step)
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, search.rays, view.lens)
    reach = (inside[0], outside[1])
    mark_occluded(rays, scale, frame, half_angle, search.nearer, reach, search.margin_px)
    if wider > 0:
        profiles = sample_nearest(view.pixels, view.table, rays, steps)
    else:
        lit = np.ones(len(steps), np.bool_)
        near, _ = sample(view.pixels, view.table, rays, steps, lit, len(steps))
        profiles = near.astype(np.float64)
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
        PredictionInputs(view.pixels, view.table, view.sensor, rays, tables, ambient)
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
