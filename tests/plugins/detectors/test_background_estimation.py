"""In real time, the appearance is estimated in a thread."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from measure.simulation.catalogue import webcam_scene
from measure.simulation.renderer import Renderer
from measure_plugins._outline import self_calibration as calibration
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of
from tests.simulated.mirroring import mirrored

FIRST_ESTIMATE = 2
"""The picture with which the first one begins."""


@pytest.fixture(scope="module")
def shown():
    """A camera, and its pictures with where the balls are in them."""
    scene = mirrored(webcam_scene())
    camera = scene.cameras[0]
    renderer, out = Renderer(scene, camera.name), []
    for k in range(4):
        pixels, pose = renderer.picture(k / 30, k), scene.trajectory.at(np.array([k / 30]))[0]
        expected = [
            expect(camera, ball.name, camera.camera_from_world.apply(center), ball.radius_mm)
            for ball, center in zip(scene.body.balls, pose.apply(scene.body.centers), strict=True)
        ]
        out.append((image_of(camera, pixels, k / 30), expected))
    return scene, camera, out


def detector_of(scene, camera):
    return OutlineDetector(OutlineConfig(), scene.body, camera)


def centers(found):
    return np.array([detection.center_px for detection in found])


def test_pictures_are_measured_during_an_estimation(shown, monkeypatch):
    scene, camera, pictures = shown
    go, really = threading.Event(), calibration.estimate_appearance
    monkeypatch.setattr(
        calibration, "estimate_appearance", lambda *given: go.wait(60) and really(*given)
    )
    live = detector_of(scene, camera)
    live.enter_realtime()
    before = live._appearance
    seen = [centers(live.detect(*picture)) for picture in pictures[:FIRST_ESTIMATE]]
    assert live._appearance is before, "the estimation still waits"
    go.set()
    live._background._running.result(60)
    after = centers(live.detect(*pictures[FIRST_ESTIMATE]))
    assert live._appearance is not before

    waiting = detector_of(scene, camera)
    expected = [centers(waiting.detect(*picture)) for picture in pictures[:FIRST_ESTIMATE]]
    np.testing.assert_array_equal(seen[0], expected[0])
    assert np.any(seen[1] != expected[1]), "the control: it is measured anew with what it teaches"
    np.testing.assert_array_equal(live._appearance.point_lights, waiting._appearance.point_lights)
    # How looks answer was measured with one picture here, with another there.
    np.testing.assert_allclose(after, centers(waiting.detect(*pictures[FIRST_ESTIMATE])), atol=0.02)


@pytest.mark.parametrize("relit", [False, True])
def test_the_appearance_is_estimated_again_once_the_light_has_changed(shown, monkeypatch, relit):
    scene, camera, pictures = shown
    made, really = [], calibration.estimate_appearance
    monkeypatch.setattr(
        calibration, "estimate_appearance", lambda *given: made.append(1) or really(*given)
    )
    turned = [lamp.position_mm * [-1, -1, 1] for lamp in scene.lighting.lights]
    lamps = map(lambda lamp, at: replace(lamp, position_mm=at), scene.lighting.lights, turned)
    lighting = replace(scene.lighting, lights=tuple(lamps))
    other = Renderer(replace(scene, lighting=lighting), camera.name)
    detector = detector_of(scene, camera)
    for k in range(32):
        image, expected = pictures[k % 4]
        pixels = other.picture(image.time_s, k) if relit and k == 31 else image.pixels
        detector.detect(image_of(camera, pixels, k / 30), expected)
    assert len(made) == 2 + relit


def test_an_error_of_an_estimation_is_raised(shown, monkeypatch):
    scene, camera, pictures = shown

    def broken(*arguments):
        raise ArithmeticError("no estimate")

    monkeypatch.setattr(calibration, "estimate_appearance", broken)
    live = detector_of(scene, camera)
    live.enter_realtime()
    for picture in pictures[:FIRST_ESTIMATE]:
        live.detect(*picture)
    assert isinstance(live._background._running.exception(60), ArithmeticError)
    with pytest.raises(ArithmeticError, match="no estimate"):
        live.detect(*pictures[FIRST_ESTIMATE])
