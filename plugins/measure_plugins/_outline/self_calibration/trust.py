"""The correction weight: the share of the predicted bias of edges that is subtracted.

Edges are found twice in a picture, without grey and with it, and twice on its prediction. The
separation of the two does not depend on where the ball is: the slope of the observed separation
over the predicted one shows how good predictions are. It is nearly one in front of plain grey, and
less than half in pictures of webcams. See docs/explanation/outline.md, formula 20.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.appearance.model import DEFAULT_CORRECTION_WEIGHT, Appearance
from measure_plugins._outline.fitting.edges import find_edge_pairs
from measure_plugins._outline.sampling.ray_groups import TOGETHER
from measure_plugins._outline.sampling.rays import CLEAR
from measure_plugins._outline.self_calibration.patch import BallPatch, prediction_inputs

_WEIGHT_UNSEEN, _WEIGHT_RANGE = 0.65, 0.4
"""The weight at a slope of 0, and how much more at a slope of 1: chosen on simulated scenes in
other light, with known truth."""
_PRIOR_SLOPE = (DEFAULT_CORRECTION_WEIGHT - _WEIGHT_UNSEEN) / _WEIGHT_RANGE
_PRIOR_PX2 = 100.0  # Prior sum of squared predicted separations, with the slope above
_MIN_RAYS = 100
_MIN_CONTRAST = 0.06
_ITERATIONS = 10
_TINY = 1e-9


class PredictionAgreement(NamedTuple):
    """Regression of observed on predicted separations of edge pairs: sums over rays."""

    both_px2: float  # of observed times predicted ones
    predicted_px2: float  # of squared predicted ones


def correction_weight_of(agreements: Iterable[PredictionAgreement]) -> float:
    """The correction weight by the agreement of all cameras of a recording."""
    both, predicted = _PRIOR_SLOPE * _PRIOR_PX2, _PRIOR_PX2
    for one in agreements:
        both, predicted = both + one.both_px2, predicted + one.predicted_px2
    return _WEIGHT_UNSEEN + _WEIGHT_RANGE * min(max(both / predicted, 0.0), 1.0)


def prediction_agreement(
    patches: Sequence[BallPatch], appearance: Appearance
) -> PredictionAgreement:
    """Agreement of predicted and observed separations over patches, robustly (Tukey)."""
    pairs = [
        (np.empty(0), np.empty(0)),
        *(_edge_separations(patch, appearance) for patch in patches),
    ]
    seen, predicted = (np.concatenate(some) for some in zip(*pairs, strict=True))
    if len(seen) < _MIN_RAYS:
        return PredictionAgreement(0.0, 0.0)
    weights = np.ones(len(seen))
    for _ in range(_ITERATIONS):
        both, square = float(weights @ (seen * predicted)), float(weights @ predicted**2)
        left = seen - both / (square + _TINY) * predicted
        limit = 4.685 * 1.4826 * float(np.median(np.abs(left))) + _TINY
        weights = np.clip(1 - (left / limit) ** 2, 0, None) ** 2
    return PredictionAgreement(both, square)


def _edge_separations(patch: BallPatch, appearance: Appearance) -> tuple[Floats, Floats]:
    """Separations of edge pairs on clear rays (k,), observed and predicted, less their medians."""
    inputs = prediction_inputs(patch, appearance, in_groups=True)
    found = find_edge_pairs(inputs)
    seen = found.at[0] - found.at[1]
    predicted = np.repeat(found.predicted[0] - found.predicted[1], TOGETHER)
    clear = (inputs.rays.status == CLEAR) & np.isfinite(seen) & np.isfinite(predicted)
    clear &= found.contrast.min(axis=0) > _MIN_CONTRAST
    if not clear.any():
        return np.empty(0), np.empty(0)
    seen, predicted = seen[clear], predicted[clear]
    return seen - np.median(seen), predicted - np.median(predicted)
