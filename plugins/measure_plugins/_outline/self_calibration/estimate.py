"""One lesson: a camera's tone curve, blur, kind of surface and lamps, from balls in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.self_calibration.environment_map import Backdrop, with_room
from measure_plugins._outline.self_calibration.patch import Sight
from measure_plugins._outline.self_calibration.point_lights import Light, light_on, with_lamps
from measure_plugins._outline.self_calibration.response_and_blur import (
    BENDS_SD,
    as_stated,
    bent_appearance,
    left_by,
    refined_bends,
    straight_appearance,
    surface_bounds,
    telling,
    unclipped,
    with_or_without_mirroring,
)
from measure_plugins._outline.self_calibration.trust import Agreement, agreement_on, believed_share

_HOPELESS = 0.9
_BENT_BELOW = 0.72
"""Share of the misfit's square that a bent curve must leave, by the light of lamps, to be believed:
free bends also take up what else is wrong with the model. On the program's own scenes and on
rendered recordings it is at least 0.76 where the curve is the standard's, but for two cameras of
a hundred and fifty (0.62 under a single desk lamp, 0.68 far away); where it is bent, it is at most
0.80 before dark cloth, and up to 0.92 before colourful rooms: see `one_kind` for those.
A curve that leaves more than the first without lamps is not tried any further: of those believed in
the end, none did."""


_BELIEVED_BENT = 1.0
"""The same where cameras of one kind have shown together that their curve is bent."""


@dataclass(frozen=True, eq=False)
class Lesson:
    """What balls in view taught.

    Attributes:
        appearance: to go on with.
        bent: whether its tone curve is a bent one.
        left: share of the misfit's square that a bent curve leaves of a straight one's.
        bends: (3,) of that curve, believed or not, see `appearance.bent_table`.
        light: what the pictures say of the light, by the straight curve.
        light_if_bent: the same by the bent one; None where that leaves too much to be tried.
        agreement: how well what the appearance foresees agrees with what is seen.
    """

    appearance: Appearance
    bent: bool
    left: float
    bends: Floats
    light: Light
    light_if_bent: Light | None
    agreement: Agreement

    def light_by(self, bent: bool) -> Light | None:
        """What the pictures say of the light by the bent curve, or by the straight one."""
        return self.light_if_bent if bent else self.light


def take_lesson(
    sights: Sequence[Sight],
    now: Appearance,
    world_from_camera: Floats,
    believe_bent: bool = False,
    backdrops: Sequence[Backdrop] = (),
) -> Lesson | None:
    """What explains the sights; the simplest unless another does clearly. None: too few sights.

    Whether the tone curve is bent is told by the light of lamps: freely fitted shading takes up
    part of a bend, and a bend part of what free shading leaves.

    Args:
        sights: balls in the camera's pictures.
        now: the appearance at present.
        world_from_camera: (3, 3) how the camera is turned.
        believe_bent: whether other cameras say that the curve is bent.
        backdrops: the pictures without the balls.
    """
    useful = telling(sights)
    if not useful:
        return None
    start, clear = as_stated(now), unclipped(useful)
    if_straight, if_bent = surface_bounds(useful, start.table)
    unlit = straight_appearance(clear, start, if_straight)
    light, light_if_bent = light_on(clear, unlit, world_from_camera), None
    straight, bent = with_lamps(clear, unlit, light), bent_appearance(clear, unlit, if_bent)
    left = left_by(bent, unlit, clear)
    if believe_bent or left < _HOPELESS:
        lit = with_lamps(clear, bent, light_on(clear, bent, world_from_camera))
        bent = refined_bends(clear, lit)
        light_if_bent = light_on(clear, bent, world_from_camera)
        bent = with_lamps(clear, bent, light_if_bent)
        left = left_by(bent, straight, clear)
    believed = left < (_BELIEVED_BENT if believe_bent else _BENT_BELOW)
    in_room = with_room(useful, bent if believed else straight, backdrops)
    unweighed = with_or_without_mirroring(useful, in_room)
    agreement = agreement_on(useful, unweighed)
    appearance = replace(unweighed, believed=believed_share([agreement]))
    return Lesson(appearance, believed, left, bent.bends, light, light_if_bent, agreement)


_CLEARLY = 0.11
"""How clear a bend must be, times how strong: minus the logarithm of the share of the misfit's
square that bent curves leave, in the mean of the cameras, and the middle one's S, in standard
deviations of cameras'. Free bends take up what else is wrong with the model, but mildly. Of fifty
recordings, rendered, path-traced and altered, it is at most 0.08 with the standard's curve; with
bent ones at least 0.16, but 0.07 for a mild bend in a cluttered room, which stays unnoticed."""


def bent_together(lessons: Sequence[Lesson]) -> bool:
    """Whether cameras that seem to be of one kind show that their curve is bent.

    They seem to be where every camera's curve, as far as it can tell, is nearer to the middle one
    than that is to the standard's.
    """
    if len(lessons) < 2:
        return False
    bends = np.array([lesson.bends for lesson in lessons]) / BENDS_SD
    middle = np.median(bends, axis=0)
    if np.any(np.linalg.norm(bends - middle, axis=1) >= np.linalg.norm(middle)):
        return False
    clear = -np.mean(np.log([lesson.left for lesson in lessons]))
    return bool(clear * abs(middle[2]) > _CLEARLY)
