"""A tone curve that cameras show together and single ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.appearance.model import first_appearance
from measure_plugins._outline.self_calibration.estimate import (
    AppearanceEstimate,
    has_common_response,
)
from measure_plugins._outline.self_calibration.point_lights import LightEquations
from tests.plugins.outline.estimates import TIMES_S, calibration_of, cones, estimated
from tests.plugins.rendering import picture, scenes

_MILD = 0.02
"""A sixth of the S of a strongly bent curve: too little for one camera."""


def estimates_of(shares, bends):
    """An estimate per camera."""
    start = first_appearance("srgb")
    dark = LightEquations(np.zeros((0, 4)), np.zeros((0, 0)), np.zeros(0))
    return [
        AppearanceEstimate(start, False, left, np.array(b), dark, None, np.zeros(2))
        for left, b in zip(shares, bends, strict=True)
    ]


ALIKE = [[-0.01, -0.05, 0.05], [-0.02, 0.02, 0.03], [-0.02, 0.0, 0.04], [-0.03, -0.03, 0.06]]


def test_cameras_together_show_a_bend_that_only_one_accepts():
    assert has_common_response(estimates_of([0.77, 0.93, 0.76, 0.56], ALIKE))


@pytest.mark.parametrize(
    ("shares", "strength"), [([0.97, 0.95, 0.87, 0.92], 1.0), ([0.65, 0.82, 0.73, 0.87], 0.4)]
)
def test_other_model_errors_are_no_common_bend(shares, strength):
    """Neither a strong one that explains little, nor a mild one that explains more."""
    assert not has_common_response(estimates_of(shares, strength * np.array(ALIKE)))


def test_one_deviating_camera_makes_no_common_bend():
    bends = [[0.0, 0.0, 0.01], [0.0, 0.01, 0.0], [-0.01, 0.0, 0.0], [-0.04, 0.0, 0.06]]
    assert not has_common_response(estimates_of([0.95, 0.94, 0.95, 0.3], bends))


def test_one_camera_alone_has_no_common_response():
    assert not has_common_response(estimates_of([0.5], ALIKE[:1]))
    assert not has_common_response([])


class Mild:
    """A camera whose tone curve bends so mildly that it is not accepted alone."""

    def __init__(self):
        scene, name = scenes()["still"], "cam1"
        camera = scene.camera(name)
        values = np.arange(256) / 255
        curve = np.rint(255 * (values - _MILD * np.sin(2 * np.pi * values))).astype(np.uint8)
        self.pictures = [
            (curve[picture(scene, name, time_s, k)], cones(scene, camera, time_s))
            for k, time_s in enumerate(TIMES_S)
        ]
        self.calibration = calibration_of(camera)
        self.now = first_appearance("srgb")

    def see(self, numbers):
        """The appearance after these pictures, of which every other one is the same."""
        for number in numbers:
            pixels, balls = self.pictures[number % 2]
            if self.calibration.wants_image(len(balls), number / 30):
                self.now = estimated(self.calibration, pixels, balls, [], self.now) or self.now
        return self.now

    def fuse(self, bent):
        """The appearance fused with its own estimate alone."""
        self.now = self.calibration.fuse(self.now, [self.calibration.estimate], bent)
        return self.now


def test_a_common_bend_is_accepted_from_then_on():
    camera = Mild()
    assert np.all(np.abs(camera.see(range(1, 9)).bends) < 1e-5)
    assert camera.calibration.estimate.residual_ratio > 0.72
    fused = camera.fuse(bent=True)
    assert 0.3 * _MILD < fused.bends[2] < 2 * _MILD
    assert camera.fuse(bent=True) is fused, "nothing new"
    assert camera.see(range(9, 33)).bends[2] > 0.3 * _MILD


def test_without_a_common_bend_none_is_accepted():
    assert np.all(np.abs(Mild().see(range(1, 33)).bends) < 1e-5)
