"""How much of what predictions say of edges is to be believed.

Edges are found twice in a picture, without grey and by all colours, and twice on the prediction of
it. How far apart the two lie along a ray does not depend on where the ball is: how much is seen
there of what is foreseen tells how good predictions are. Before plain grey nearly all of it is, on
webcam pictures less than half.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.appearance.model import BELIEVED, Appearance
from measure_plugins._outline.fitting.edges import find_twice
from measure_plugins._outline.sampling.ray_groups import TOGETHER
from measure_plugins._outline.sampling.rays import CLEAR
from measure_plugins._outline.self_calibration.patch import Sight, prediction_inputs

_UNSEEN, _SEEN = 0.65, 0.4
"""What is believed where nothing of what is foreseen is seen, and how much more where all is:
chosen on own scenes in other light, with the truth in view."""
_USUAL = (BELIEVED - _UNSEEN) / _SEEN
_USUAL_PX2 = 100.0
"""What is usual counts as much as a camera's pictures do in which so much is foreseen."""
_FEWEST_RAYS = 100
_LEAST_CONTRAST = 0.06
_ROUNDS = 10
_NOTHING = 1e-9


class Agreement(NamedTuple):
    """How what is seen of the edges' distances goes with what is foreseen: sums over rays.

    Attributes:
        both_px2: of seen times foreseen.
        foreseen_px2: of foreseen, squared.
    """

    both_px2: float
    foreseen_px2: float


def believed_share(agreements: Iterable[Agreement]) -> float:
    """What to believe of predictions that agree so well with what cameras of a recording see."""
    both, foreseen = _USUAL * _USUAL_PX2, _USUAL_PX2
    for one in agreements:
        both, foreseen = both + one.both_px2, foreseen + one.foreseen_px2
    return _UNSEEN + _SEEN * min(max(both / foreseen, 0.0), 1.0)


def agreement_on(sights: Sequence[Sight], appearance: Appearance) -> Agreement:
    """How well the predictions of balls agree with what is seen of them, robustly (Tukey)."""
    pairs = [(np.empty(0), np.empty(0)), *(_apart(sight, appearance) for sight in sights)]
    seen, foreseen = (np.concatenate(some) for some in zip(*pairs, strict=True))
    if len(seen) < _FEWEST_RAYS:
        return Agreement(0.0, 0.0)
    weights = np.ones(len(seen))
    for _ in range(_ROUNDS):
        both, square = float(weights @ (seen * foreseen)), float(weights @ foreseen**2)
        left = seen - both / (square + _NOTHING) * foreseen
        limit = 4.685 * 1.4826 * float(np.median(np.abs(left))) + _NOTHING
        weights = np.clip(1 - (left / limit) ** 2, 0, None) ** 2
    return Agreement(both, square)


def _apart(sight: Sight, appearance: Appearance) -> tuple[Floats, Floats]:
    """How far the two edges lie apart on clear rays (k,), seen and foreseen, less the medians."""
    inputs = prediction_inputs(sight, appearance, in_groups=True)
    found = find_twice(inputs)
    seen = found.at[0] - found.at[1]
    foreseen = np.repeat(found.predicted[0] - found.predicted[1], TOGETHER)
    clear = (inputs.rays.status == CLEAR) & np.isfinite(seen) & np.isfinite(foreseen)
    clear &= found.contrast.min(axis=0) > _LEAST_CONTRAST
    if not clear.any():
        return np.empty(0), np.empty(0)
    seen, foreseen = seen[clear], foreseen[clear]
    return seen - np.median(seen), foreseen - np.median(foreseen)
