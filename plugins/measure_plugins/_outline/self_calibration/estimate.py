"""One estimate of a camera's tone curve, blur and lights, and of the surface of the balls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from measure.arrays import Floats
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.self_calibration.environment_map import (
    BackgroundAccumulator,
    with_environment,
)
from measure_plugins._outline.self_calibration.patch import BallPatch
from measure_plugins._outline.self_calibration.point_lights import (
    LightEquations,
    light_equations,
    with_point_lights,
)
from measure_plugins._outline.self_calibration.response_and_blur import (
    as_stated,
    bent_appearance,
    choose_grazing_reflection,
    refined_bends,
    residual_ratio,
    straight_appearance,
    surface_bounds,
    unclipped_patches,
    useful_patches,
)
from measure_plugins._outline.self_calibration.trust import (
    PredictionAgreement,
    correction_weight_of,
    prediction_agreement,
)

_TRY_BENT_BELOW = 0.9
_BENT_BELOW = 0.72
"""Residual ratio of a bent to a straight curve below which a bent curve is accepted, with point
lights: free bends also take up other errors of the model. On simulated scenes and rendered
recordings it is at least 0.76 where the curve is the standard's, except for two cameras of a
hundred and fifty (0.62 under a single desk lamp, 0.68 far away); where it is bent, it is at most
0.80 in front of dark cloth, and up to 0.92 in colourful rooms. The first is the ratio without point
lights above which bent curves are not tried further: no accepted one exceeded it."""


@dataclass(frozen=True, eq=False)
class AppearanceEstimate:
    """One estimate from the patches of a camera.

    Attributes:
        appearance: the estimate.
        light: equations of the point lights, by its tone curve.
        agreement: of predicted and observed separations of edge pairs.
    """

    appearance: Appearance
    light: LightEquations
    agreement: PredictionAgreement


def estimate_appearance(
    patches: Sequence[BallPatch],
    now: Appearance,
    world_from_camera: Floats,
    backgrounds: Sequence[BackgroundAccumulator] = (),
) -> AppearanceEstimate | None:
    """The appearance that fits the patches best; None if there are too few.

    A more complex model is chosen only where it fits clearly better. Whether the tone curve is bent
    is decided with the shading of point lights: a freely fitted polynomial takes up part of a bend.

    Args:
        patches: balls in the camera's pictures.
        now: the present appearance.
        world_from_camera: (3, 3) rotation of the camera.
        backgrounds: the pictures without the balls.
    """
    useful = useful_patches(patches)
    if not useful:
        return None
    start, clear = as_stated(now), unclipped_patches(useful)
    if_straight, if_bent = surface_bounds(useful, start.table)
    without_lights = straight_appearance(clear, start, if_straight)
    light = light_equations(clear, without_lights, world_from_camera)
    fitted = with_point_lights(clear, without_lights, light)
    bent = bent_appearance(clear, without_lights, if_bent)
    if residual_ratio(bent, without_lights, clear) < _TRY_BENT_BELOW:
        lit = with_point_lights(clear, bent, light_equations(clear, bent, world_from_camera))
        bent = refined_bends(clear, lit)
        light_if_bent = light_equations(clear, bent, world_from_camera)
        bent = with_point_lights(clear, bent, light_if_bent)
        if residual_ratio(bent, fitted, clear) < _BENT_BELOW:
            fitted, light = bent, light_if_bent
    with_map = with_environment(useful, fitted, backgrounds)
    chosen = choose_grazing_reflection(useful, with_map)
    agreement = prediction_agreement(useful, chosen)
    appearance = replace(chosen, correction_weight=correction_weight_of([agreement]))
    return AppearanceEstimate(appearance, light, agreement)
