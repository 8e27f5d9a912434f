"""The correction weight: the better predictions agree with pictures, the larger."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.appearance.model import DEFAULT_CORRECTION_WEIGHT
from measure_plugins._outline.self_calibration.trust import (
    correction_weight_of,
    prediction_agreement,
)
from tests.plugins.outline.estimates import calibration_of, settled
from tests.plugins.rendering import relit

GREY, WEBCAM = "plain-grey 14", "still 12"


@pytest.fixture(scope="module")
def weights():
    """Correction weights of two cameras, each alone, and fused."""
    return {name: _weights(relit()[name]) for name in (GREY, WEBCAM)}


def _weights(scene):
    calibrations = [calibration_of(scene.camera(name)) for name in ("cam0", "cam1")]
    alone = [settled(calibration, scene, f"cam{i}") for i, calibration in enumerate(calibrations)]
    known = [calibration.estimate for calibration in calibrations]
    fused = [x.fuse(now, known, bent=False) for x, now in zip(calibrations, alone, strict=True)]
    return [now.correction_weight for now in alone], [now.correction_weight for now in fused]


def test_plain_pictures_have_a_larger_weight_than_webcam_ones(weights):
    assert min(weights[GREY][1]) > 0.93 > 0.86 > max(weights[WEBCAM][1])


@pytest.mark.parametrize("scene", [GREY, WEBCAM])
def test_fused_cameras_have_the_same_weight(weights, scene):
    alone, fused = weights[scene]
    assert fused[0] == pytest.approx(fused[1])
    assert fused[0] not in alone


def test_without_evidence_the_weight_is_the_default():
    for nothing in ([], [np.zeros(2)]):
        assert correction_weight_of(nothing) == pytest.approx(DEFAULT_CORRECTION_WEIGHT)
    assert not prediction_agreement([], None).any()


def test_weight_rises_with_the_slope_of_the_separations():
    slopes = (-0.5, 0.0, 0.5, 1.0, 2.0)
    weights = [correction_weight_of([np.array([slope * 1e4, 1e4])]) for slope in slopes]
    assert weights == sorted(weights)
    assert weights[0] == pytest.approx(0.65)
    assert weights[-1] == pytest.approx(1.05)


def test_cameras_count_by_their_predicted_separations():
    sure, unsure = np.array([900.0, 1000.0]), np.array([0.0, 10.0])
    both, one = correction_weight_of([sure, unsure]), correction_weight_of([sure])
    assert both == pytest.approx(one, abs=0.01)
