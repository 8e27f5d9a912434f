"""One lesson: a camera's tone curve, blur, kind of surface and lamps, from balls in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from measure.arrays import Floats
from measure_plugins._edges.appearance import Appearance
from measure_plugins._edges.appearance_fit import (
    Sight,
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
from measure_plugins._edges.lamps_fit import with_lamps
from measure_plugins._edges.room_fit import Backdrop, with_room

_HOPELESS = 0.9
_BENT_BELOW = 0.72
"""Share of the misfit's square that a bent curve must leave, by the light of lamps, to be believed:
free bends also take up what else is wrong with the model. On the program's own scenes and on
rendered recordings it is at least 0.75 where the curve is the standard's; where it is bent, it is
at most 0.73 before dark cloth, and up to 0.93 before colourful rooms, where bends stay unnoticed.
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
    """

    appearance: Appearance
    bent: bool
    left: float
    bends: Floats


def take_lesson(
    sights: Sequence[Sight],
    now: Appearance,
    believe_bent: bool = False,
    backdrops: Sequence[Backdrop] = (),
) -> Lesson | None:
    """What explains the sights; the simplest unless another does clearly. None: too few sights.

    Whether the tone curve is bent is told by the light of lamps: freely fitted shading takes up
    part of a bend, and a bend part of what free shading leaves.

    Args:
        sights: balls in the camera's pictures.
        now: the appearance at present.
        believe_bent: whether other cameras say that the curve is bent.
        backdrops: the pictures without the balls.
    """
    useful = telling(sights)
    if not useful:
        return None
    start, clear = as_stated(now), unclipped(useful)
    if_straight, if_bent = surface_bounds(useful, start.table)
    unlit = straight_appearance(clear, start, if_straight)
    straight, bent = with_lamps(clear, unlit), bent_appearance(clear, unlit, if_bent)
    left = left_by(bent, unlit, clear)
    if believe_bent or left < _HOPELESS:
        bent = with_lamps(clear, refined_bends(clear, with_lamps(clear, bent)))
        left = left_by(bent, straight, clear)
    believed = left < (_BELIEVED_BENT if believe_bent else _BENT_BELOW)
    in_room = with_room(useful, bent if believed else straight, backdrops)
    appearance = with_or_without_mirroring(useful, in_room)
    return Lesson(appearance, believed, left, bent.bends)
