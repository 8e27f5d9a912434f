"""The correction weight: the share of the predicted bias of edges that is subtracted.

The two edges of a ray, without grey and with it, lie apart by an amount that does not depend on
where the ball is. The slope of what is seen of it over what is predicted tells how good predictions
are: nearly one before plain grey, less than half in pictures of webcams. See
docs/explanation/outline.md, formula 20.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from measure.arrays import Floats
from measure.limits import TINY
from measure_plugins._outline.appearance.model import DEFAULT_CORRECTION_WEIGHT, Appearance
from measure_plugins._outline.fitting.edges import find_edge_pairs
from measure_plugins._outline.sampling.rays import CLEAR, TOGETHER
from measure_plugins._outline.self_calibration.patch import BallPatch, grouped_inputs

_WEIGHT_UNSEEN, _WEIGHT_RANGE = 0.65, 0.4
"""The weight at a slope of 0, and how much more at a slope of 1: chosen on simulated scenes in
other light, with known truth."""
_PRIOR = 100.0 * np.array([(DEFAULT_CORRECTION_WEIGHT - _WEIGHT_UNSEEN) / _WEIGHT_RANGE, 1.0])
_MIN_RAYS = 100
_MIN_CONTRAST = 0.06
_ITERATIONS = 10


def correction_weight_of(agreements: Iterable[Floats]) -> float:
    """The correction weight by the agreement of all cameras of a recording."""
    both, square = sum(agreements, start=_PRIOR)
    return float(_WEIGHT_UNSEEN + _WEIGHT_RANGE * np.clip(both / square, 0.0, 1.0))


def prediction_agreement(patches: Sequence[BallPatch], appearance: Appearance) -> Floats:
    """Agreement of seen and predicted separations of edge pairs, robustly (Tukey's biweight).

    Returns:
        (2,) sums in px^2 over rays: of seen times predicted separations, and of predicted squared.
    """
    pairs = [_edge_separations(patch, appearance) for patch in patches]
    seen, predicted = np.concatenate([np.empty((2, 0)), *pairs], axis=1)
    if seen.size < _MIN_RAYS:
        return np.zeros(2)
    weights, products = np.ones(len(seen)), np.stack([seen * predicted, predicted**2])
    for _ in range(_ITERATIONS):
        both, square = sums = products @ weights
        left = seen - both / (square + TINY) * predicted
        limit = 4.685 * 1.4826 * np.median(np.abs(left)) + TINY
        weights = np.clip(1 - (left / limit) ** 2, 0, None) ** 2
    return np.asarray(sums)


def _edge_separations(patch: BallPatch, appearance: Appearance) -> Floats:
    """Separations (2, k) on clear rays, seen and predicted, less their medians."""
    inputs = grouped_inputs(patch, appearance)
    found = find_edge_pairs(inputs)
    apart = np.stack([found.at, np.repeat(found.predicted, TOGETHER, axis=1)])
    apart = apart[:, 0] - apart[:, 1]
    clear = (inputs.rays.status == CLEAR) & np.isfinite(apart).all(axis=0)
    clear &= found.contrast.min(axis=0) > _MIN_CONTRAST
    apart = apart[:, clear]
    return apart - np.median(apart, axis=1, keepdims=True) if clear.any() else apart
