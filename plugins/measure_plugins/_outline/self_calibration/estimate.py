"""One estimate of a camera's tone curve, blur and lights, and of the surface of the balls.

See docs/explanation/outline.md, formula 22.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.self_calibration.patch import BallPatch
from measure_plugins._outline.self_calibration.point_lights import (
    LightEquations,
    light_equations,
    with_point_lights,
)
from measure_plugins._outline.self_calibration.response_and_blur import (
    BENDS_SD,
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
    correction_weight_of,
    prediction_agreement,
)

_TRY_BENT_BELOW = 0.9
_BENT_BELOW = 0.72
"""Residual ratio (see `AppearanceEstimate`) below which a bent curve is accepted, with point
lights: free bends also take up other errors of the model. On simulated scenes and rendered
recordings it is at least 0.76 where the curve is the standard's, except for two cameras of a
hundred and fifty (0.62 under a single desk lamp, 0.68 far away); where it is bent, it is at most
0.80 in front of dark cloth, and up to 0.92 in colourful rooms, for which see `has_common_response`.
The first is the ratio without point lights above which bent curves are not tried further: no
accepted one exceeded it."""


@dataclass(frozen=True, eq=False)
class AppearanceEstimate:
    """One estimate from the patches of a camera."""

    appearance: Appearance
    bent: bool  # whether its tone curve is a bent one
    residual_ratio: float  # mean square residual with a bent curve, per that with a straight one
    bends: Floats  # (3,) of the bent curve, accepted or not, see `bent_table`
    light: LightEquations  # equations of the point lights, by the straight curve
    light_if_bent: LightEquations | None  # the same by the bent one; None where that was not tried
    agreement: Floats  # (2,) of seen and predicted edges, see `prediction_agreement`

    def light_by(self, bent: bool) -> LightEquations | None:
        """Equations of the point lights by the bent curve, or by the straight one."""
        return self.light_if_bent if bent else self.light


def estimate_appearance(
    patches: Sequence[BallPatch],
    now: Appearance,
    world_from_camera: Floats,
    assume_bent: bool = False,
) -> AppearanceEstimate | None:
    """The appearance that fits the patches best; None if there are too few.

    A more complex model is chosen only where it fits clearly better. Whether the tone curve is bent
    is decided with the shading of point lights: a freely fitted polynomial takes up part of a bend.

    Args:
        world_from_camera: (3, 3) rotation of the camera.
        assume_bent: whether the cameras together have shown that their common curve is bent.
    """
    useful = useful_patches(patches)
    if not useful:
        return None
    start, clear = as_stated(now), unclipped_patches(useful)
    if_straight, if_bent = surface_bounds(useful, start.table)
    without_lights = straight_appearance(clear, start, if_straight)
    light, light_if_bent = light_equations(clear, without_lights, world_from_camera), None
    straight = with_point_lights(clear, without_lights, light)
    bent = bent_appearance(clear, without_lights, if_bent)
    ratio = residual_ratio(bent, without_lights, clear)
    if assume_bent or ratio < _TRY_BENT_BELOW:
        light_if_bent = light_equations(clear, bent, world_from_camera)
        bent = refined_bends(clear, with_point_lights(clear, bent, light_if_bent))
        light_if_bent = light_equations(clear, bent, world_from_camera)
        bent = with_point_lights(clear, bent, light_if_bent)
        ratio = residual_ratio(bent, straight, clear)
    is_bent = ratio < (1.0 if assume_bent else _BENT_BELOW)
    chosen = choose_grazing_reflection(useful, bent if is_bent else straight)
    agreement = prediction_agreement(useful, chosen)
    chosen = replace(chosen, correction_weight=correction_weight_of([agreement]))
    return AppearanceEstimate(chosen, is_bent, ratio, bent.bends, light, light_if_bent, agreement)


_MIN_BEND_EVIDENCE = 0.11
"""Least evidence of a common bend: minus the mean logarithm of the cameras' residual ratios, times
the S of their median curve in units of its prior sd. On fifty recordings (rendered, path-traced and
altered) it is at most 0.08 with the standard's curve; with bent ones at least 0.16, except 0.07 for
a mild bend in a cluttered room, which stays unnoticed."""


def has_common_response(estimates: Sequence[AppearanceEstimate]) -> bool:
    """Whether the cameras have a common response curve other than the standard's (formula 22).

    That is tested where every camera's curve is nearer to their median than that is to the
    standard's.
    """
    if len(estimates) < 2:
        return False
    bends = np.array([estimate.bends for estimate in estimates]) / BENDS_SD
    middle = np.median(bends, axis=0)
    if np.any(np.linalg.norm(bends - middle, axis=1) >= np.linalg.norm(middle)):
        return False
    evidence = -np.mean(np.log([estimate.residual_ratio for estimate in estimates]))
    return bool(evidence * abs(middle[2]) > _MIN_BEND_EVIDENCE)
