"""The part of a picture that shows a ball, and the inputs of its prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.appearance.point_lights import lights_about, shade_by_lights
from measure_plugins._outline.appearance.radial_basis import RadialTables
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.fitting.edges import PredictionInputs
from measure_plugins._outline.sampling.ray_groups import TOGETHER, middle_angles
from measure_plugins._outline.sampling.rays import RaySet


@dataclass(frozen=True, eq=False)
class BallPatch:
    """The part of a picture that shows a ball, with the rays across its outline."""

    pixels: Bytes  # (h, w, 3) the part of the picture
    rays: RaySet  # n rays across the outline as found, in px of that part
    half_angle: float  # of the cone, rad
    scale: float  # px per rad
    frame: Floats  # (3, 3) about the axis, see `rays.frame_about`
    behind: Floats  # see `behind.ball_reflection_shares`
    distance: float  # of the ball, mm

    def own_rays(self) -> RaySet:
        """Its rays with a copy of their status, which sampling changes."""
        return self.rays._replace(status=self.rays.status.copy())


def prediction_inputs(
    patch: BallPatch, appearance: Appearance, in_groups: bool = False
) -> PredictionInputs:
    """Inputs of a prediction by an appearance, its ambient light on rays or on groups of them."""
    tables = appearance.tables(patch.half_angle * patch.scale, patch.half_angle)
    return PredictionInputs(
        patch.pixels,
        appearance.table,
        appearance.sensor,
        patch.own_rays(),
        tables,
        _ambient(patch, appearance, tables, in_groups),
    )


def _ambient(
    patch: BallPatch, appearance: Appearance, tables: RadialTables, in_groups: bool
) -> Ambient:
    """The light on a ball, on its rays or between them."""
    around, behind = patch.rays.around, patch.behind
    if in_groups:
        around, behind = middle_angles(around), np.ascontiguousarray(behind[:, ::TOGETHER])
    point_lights = lights_about(appearance.point_lights, patch.frame, patch.distance)
    return Ambient(
        shade_by_lights(tables.diffuse, tables.fresnel_loss[0], around, point_lights), behind
    )
