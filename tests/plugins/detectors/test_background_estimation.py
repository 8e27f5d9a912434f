"""Where poses are waited for, lessons are taken in a thread of their own."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from measure.simulation.catalogue import webcam_scene
from measure.simulation.renderer import Renderer
from measure_plugins._outline.self_calibration import schedule as learner
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of

FIRST_LESSON = 2
"""The picture with which the first one begins."""


@pytest.fixture(scope="module")
def shown():
    """A camera, and its pictures with where the balls are in them."""
    scene = webcam_scene()
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


def test_pictures_are_measured_while_a_lesson_is_taken_and_differently_after_it(shown, monkeypatch):
    scene, camera, pictures = shown
    go, really = threading.Event(), learner.take_lesson
    monkeypatch.setattr(learner, "take_lesson", lambda *told: go.wait(60) and really(*told))
    live = detector_of(scene, camera)
    live.enter_realtime()
    before = live._appearance
    seen = [centers(live.detect(*picture)) for picture in pictures[:FIRST_LESSON]]
    assert live._appearance is before, "the lesson still waits"
    go.set()
    live._aside._lesson.result(60)
    after = centers(live.detect(*pictures[FIRST_LESSON]))
    assert live._appearance is not before

    waiting = detector_of(scene, camera)
    told = [centers(waiting.detect(*picture)) for picture in pictures[:FIRST_LESSON]]
    np.testing.assert_array_equal(seen[0], told[0])
    assert np.any(seen[1] != told[1]), "the control: it is measured anew with what it teaches"
    np.testing.assert_array_equal(live._appearance.lamps, waiting._appearance.lamps)
    # How looks answer was measured with one picture here, with another there.
    np.testing.assert_allclose(after, centers(waiting.detect(*pictures[FIRST_LESSON])), atol=0.02)


def test_what_goes_wrong_in_a_lesson_is_told(shown, monkeypatch):
    scene, camera, pictures = shown

    def broken(*told):
        raise ArithmeticError("no lesson")

    monkeypatch.setattr(learner, "take_lesson", broken)
    live = detector_of(scene, camera)
    live.enter_realtime()
    for picture in pictures[:FIRST_LESSON]:
        live.detect(*picture)
    assert isinstance(live._aside._lesson.exception(60), ArithmeticError)
    with pytest.raises(ArithmeticError, match="no lesson"):
        live.detect(*pictures[FIRST_LESSON])
