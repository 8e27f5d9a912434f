"""A ball in a picture, cut out, and what is to be known to predict it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins._outline.appearance.environment_map import room_light
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.appearance.point_lights import lamp_light, seen_from
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.fitting.edges import PredictionInputs
from measure_plugins._outline.sampling.ray_groups import TOGETHER, middle_angles
from measure_plugins._outline.sampling.rays import RaySet


@dataclass(frozen=True, eq=False)
class Sight:
    """A ball in a picture, cut out, with the rays across its outline.

    Attributes:
        pixels: (h, w, 3) the part of the picture.
        rays: n rays across the outline as found, px in that part.
        half_angle: of the cone, rad.
        scale: px per rad.
        frame: (3, 3) about the axis, see `rays.frame_about`.
        behind: see `behind.mirrored_behind`.
        distance: of the ball, mm.
    """

    pixels: Bytes
    rays: RaySet
    half_angle: float
    scale: float
    frame: Floats
    behind: Floats
    distance: float

    def own_rays(self) -> RaySet:
        """Its rays with a status of their own, which sampling may change."""
        return self.rays._replace(status=self.rays.status.copy())


def prediction_inputs(
    sight: Sight, appearance: Appearance, in_groups: bool = False
) -> PredictionInputs:
    """A sight before a camera of this appearance; the light round it on its rays, or on groups."""
    tables = appearance.tables(sight.half_angle * sight.scale, sight.half_angle)
    return PredictionInputs(
        sight.pixels,
        appearance.table,
        appearance.sensor,
        sight.own_rays(),
        tables,
        _ambient(sight, appearance, tables, in_groups),
    )


def _ambient(sight: Sight, appearance: Appearance, tables: Radial, in_groups: bool) -> Ambient:
    """What the appearance says of the light round a ball, on its rays or between them."""
    around, behind = sight.rays.around, sight.behind
    if in_groups:
        around, behind = middle_angles(around), np.ascontiguousarray(behind[:, ::TOGETHER])
    lamps = seen_from(appearance.lamps, sight.frame, sight.distance)
    return Ambient(
        lamp_light(tables.diffuse, tables.kept_out[0], around, lamps),
        room_light(appearance.room, tables.grey, sight.frame, sight.half_angle, around),
        behind,
    )
