"""One look at an outline: rays across its prediction, and the edges along them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure_plugins._outline.appearance.environment_map import Room, room_light
from measure_plugins._outline.appearance.interreflection import mirrored_behind
from measure_plugins._outline.appearance.point_lights import lamp_light, seen_from
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.appearance.sensor import Sensor
from measure_plugins._outline.fitting.edges import (
    INSIDE_PX,
    OUTSIDE_PX,
    SEARCH_PX,
    Edges,
    PredictionInputs,
    corrected_edges,
    find_twice,
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

_STEP_PX, _WHOLE_PX, _WIDE_PX = 0.5, 1.0, 2.0
"""A wide look only leads to a near one, and a quick one to a better one: whole pixels will do."""
_FAR_PX = 3.0
"""A quick look that goes so much further than a near one takes every other pixel."""
_LIGHT_PER_VALUE = 0.3
"""Slope of tone curves in the shade, where contrast is scarce."""


class View(NamedTuple):
    """A picture with all that is needed to look at it.

    Attributes:
        pixels: (h, w, 3) uint8.
        table: (256,) light of each picture value.
        sensor: how it turned light into values.
        lens: (13,) lens row.
        lamps: (k, 4) in the camera frame, see `lamps`.
        room: what balls mirror of the room.
        believed: see `appearance.Appearance`.
    """

    pixels: Bytes
    table: Floats
    sensor: Sensor
    lens: Floats
    lamps: Floats
    room: Room
    believed: float


class Search(NamedTuple):
    """How to look for one outline.

    Attributes:
        axis: (3,) predicted unit direction of the ball's centre in the camera frame.
        half_angle: predicted half angle of its cone, rad.
        nearer: (k, 4) unit axes and half angles of nearer balls.
        behind: (k, 4) balls further away, see `behind.balls_behind`.
        reach_px: how far the outline may be from the prediction.
        rays: number of rays.
        min_contrast: least difference of inside and outside, in picture values from 0 to 1.
        margin_px: distance to keep from nearer balls.
        distance: of the ball, mm; unused where its size is not known.
        gain: (2, 2) see `gain.measured_gain`; used for corrected edges only.
    """

    axis: Floats
    half_angle: float
    nearer: Floats
    behind: Floats
    reach_px: float
    rays: int
    min_contrast: float
    margin_px: float
    distance: float
    gain: Floats


class Look(NamedTuple):
    """What n rays across a predicted outline show.

    Attributes:
        frame: (3, 3) see `rays.frame_about`.
        rays: those rays.
        scale: (n,) px per rad along their normals.
        edges: what was found along them.
        clear: (n,) 1 for clear rays on which inside and outside differ enough, else 0.
        use: (n,) 1 for clear rays with an edge, else 0.
    """

    frame: Floats
    rays: RaySet
    scale: Floats
    edges: Edges
    clear: Floats
    use: Floats


@compiled
def look_roughly(
    view: View,
    search: Search,
    axis: Floats,
    half_angle: float,
    reach_px: float,
    quickly: bool = False,
) -> Look:
    """Find the half-level crossings, in light, within `reach_px` of the prediction.

    Far looks, and those that have to be quick, take the nearest pixels.
    """
    wider = max(reach_px - SEARCH_PX, 0.0)
    inside = (INSIDE_PX[0] - wider, INSIDE_PX[1] - wider)
    outside = (OUTSIDE_PX[0] + wider, OUTSIDE_PX[1] + wider)
    step = _WHOLE_PX if wider > 0 or quickly else _STEP_PX
    if quickly and wider > _FAR_PX:
        step = _WIDE_PX
    steps = np.arange(inside[0], outside[1] + 1e-9, step)
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, search.rays, view.lens)
    reach = (inside[0], outside[1])
    mark_occluded(rays, scale, frame, half_angle, search.nearer, reach, search.margin_px)
    if wider > 0 or quickly:
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
    return Look(frame, rays, scale, edges, clear, use)


@compiled
def look_closely(
    view: View, search: Search, axis: Floats, half_angle: float, radial: Radial, ambient: Ambient
) -> Look:
    """The same with the edge finder's own error taken off; `ambient` by `light_about` there."""
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, search.rays, view.lens)
    reach = (INSIDE_PX[0], OUTSIDE_PX[1])
    mark_occluded(rays, scale, frame, half_angle, search.nearer, reach, search.margin_px)
    found = find_twice(
        PredictionInputs(view.pixels, view.table, view.sensor, rays, radial, ambient)
    )
    edges = corrected_edges(found, view.believed)
    clear, use = _usable(edges, rays.status, search.min_contrast, SEARCH_PX)
    return Look(frame, rays, scale, edges, clear, use)


@compiled
def light_about(view: View, search: Search, axis: Floats, radial: Radial) -> Ambient:
    """What the camera has taught about the light round a ball, along its groups of rays.

    Looks a few pixels away may use it too: lamps and walls are far, a degree does not matter.
    """
    frame, around = frame_about(axis), middle_angles(angles_around(search.rays))
    lamps = seen_from(view.lamps, frame, search.distance)
    return Ambient(
        lamp_light(radial.diffuse, radial.kept_out[0], around, lamps),
        room_light(view.room, radial.grey, frame, search.half_angle, around),
        mirrored_behind(search.behind, frame, search.half_angle, around),
    )


@compiled
def _usable(
    edges: Edges, status: Statuses, min_contrast: float, furthest_px: float
) -> tuple[Floats, Floats]:
    """Which rays are clear, and which of them have an edge to use."""
    n = len(status)
    clear, use = np.zeros(n), np.zeros(n)
    for i in range(n):
        if status[i] == CLEAR and edges.contrast[i] >= min_contrast:
            clear[i] = 1.0
            if abs(edges.shifts[i]) < furthest_px:
                use[i] = 1.0
    return clear, use
