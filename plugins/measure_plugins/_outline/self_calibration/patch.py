"""The part of a picture that shows a ball, and the inputs of its prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.appearance.point_lights import lights_about, shade_by_lights
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.fitting.edges import PredictionInputs
from measure_plugins._outline.sampling.rays import TOGETHER, RaySet


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


def prediction_inputs(patch: BallPatch, appearance: Appearance) -> PredictionInputs:
    """Inputs of a prediction by an appearance along all rays."""
    tables = appearance.tables(patch.half_angle * patch.scale, patch.half_angle)
    point_lights = lights_about(appearance.point_lights, patch.frame, patch.distance)
    lit = shade_by_lights(tables.diffuse, tables.fresnel_loss[0], patch.rays.around, point_lights)
    ambient = Ambient(lit, patch.behind)
    return PredictionInputs(
        patch.pixels, appearance.table, appearance.encoding, patch.own_rays(), tables, ambient
    )


def grouped_inputs(patch: BallPatch, appearance: Appearance) -> PredictionInputs:
    """The same with the ambient light between rays that are predicted together."""
    inputs = prediction_inputs(patch, appearance)
    between = [0.5 * (some[:, ::TOGETHER] + some[:, 1::TOGETHER]) for some in inputs.ambient]
    return inputs._replace(ambient=Ambient(*map(np.ascontiguousarray, between)))
