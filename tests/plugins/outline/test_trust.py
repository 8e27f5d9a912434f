"""The correction weight: the better predictions agree with pictures, the larger."""

from __future__ import annotations

import pytest

from measure_plugins._outline.appearance.model import DEFAULT_CORRECTION_WEIGHT
from measure_plugins._outline.self_calibration.trust import (
    PredictionAgreement,
    correction_weight_of,
    prediction_agreement,
)
from tests.plugins.outline.estimates import calibration_of, settled
from tests.plugins.rendering import relit

GREY, WEBCAM = "plain-grey 14", "still 12"


@pytest.fixture(scope="module")
def shares():
    """Correction weights of two cameras, each alone, and fused."""
    return {name: _shares(relit()[name]) for name in (GREY, WEBCAM)}


def _shares(scene):
    calibrations = [calibration_of(scene.camera(name)) for name in ("cam0", "cam1")]
    alone = [settled(calibration, scene, f"cam{i}") for i, calibration in enumerate(calibrations)]
    known = [calibration.estimate for calibration in calibrations]
    fused = [x.fuse(now, known, bent=False) for x, now in zip(calibrations, alone, strict=True)]
    return [now.correction_weight for now in alone], [now.correction_weight for now in fused]


def test_plain_pictures_have_a_larger_weight_than_webcam_ones(shares):
    assert min(shares[GREY][1]) > 0.93 > 0.86 > max(shares[WEBCAM][1])


@pytest.mark.parametrize("scene", [GREY, WEBCAM])
def test_fused_cameras_have_the_same_weight(shares, scene):
    alone, fused = shares[scene]
    assert fused[0] == pytest.approx(fused[1])
    assert fused[0] not in alone


def test_without_evidence_the_weight_is_the_default():
    assert correction_weight_of([]) == pytest.approx(DEFAULT_CORRECTION_WEIGHT)
    assert correction_weight_of([PredictionAgreement(0.0, 0.0)]) == pytest.approx(
        DEFAULT_CORRECTION_WEIGHT
    )
    nothing = prediction_agreement([], None)
    assert nothing == PredictionAgreement(0.0, 0.0)


def test_weight_rises_with_the_slope_of_the_separations():
    shares = [
        correction_weight_of([PredictionAgreement(slope * 1e4, 1e4)])
        for slope in (-0.5, 0.0, 0.5, 1.0, 2.0)
    ]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(0.65)
    assert shares[-1] == pytest.approx(1.05)


def test_cameras_count_by_their_predicted_separations():
    sure, unsure = PredictionAgreement(900.0, 1000.0), PredictionAgreement(0.0, 10.0)
    assert correction_weight_of([sure, unsure]) == pytest.approx(
        correction_weight_of([sure]), abs=0.01
    )
