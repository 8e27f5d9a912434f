"""What cameras of one kind know together: whether their tone curve is bent.

Before colourful rooms, or where balls are hidden, a single camera may not tell a mild bend from
what else is wrong with the model of a ball. Several that see it before other walls can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure_plugins._edges.appearance_fit import BENDS_SD
from measure_plugins._edges.lesson import Lesson

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
