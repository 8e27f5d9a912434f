"""What cameras tell together of a tone curve that single ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from measure.simulation import Renderer
from measure_plugins._outline.appearance.model import first_appearance
from measure_plugins._outline.self_calibration.estimate import Lesson, bent_together
from measure_plugins._outline.self_calibration.point_lights import Light
from measure_plugins._outline.self_calibration.trust import Agreement
from tests.plugins.outline.lessons import TIMES_S, cones, learner_of, taught
from tests.simulated.catalogue import scene_catalogue

_MILD = 0.02
"""A sixth of the S of a strongly bent curve: one camera does not believe it."""


def lessons_of(shares, bends):
    """A lesson per camera."""
    start = first_appearance("srgb")
    dark = Light(np.zeros((0, 4)), np.zeros((0, 0)), np.zeros(0))
    return [
        Lesson(start, False, left, np.array(b), dark, None, Agreement(0.0, 0.0))
        for left, b in zip(shares, bends, strict=True)
    ]


ALIKE = [[-0.01, -0.05, 0.05], [-0.02, 0.02, 0.03], [-0.02, 0.0, 0.04], [-0.03, -0.03, 0.06]]


def test_cameras_of_one_kind_tell_a_bend_that_only_one_of_them_would_believe():
    assert bent_together(lessons_of([0.77, 0.93, 0.76, 0.56], ALIKE))


@pytest.mark.parametrize(
    ("shares", "strength"), [([0.97, 0.95, 0.87, 0.92], 1.0), ([0.65, 0.82, 0.73, 0.87], 0.4)]
)
def test_what_free_bends_take_up_besides_is_no_bend(shares, strength):
    """Neither a strong one that explains little, nor a mild one that explains more."""
    assert not bent_together(lessons_of(shares, strength * np.array(ALIKE)))


def test_one_camera_of_another_kind_does_not_speak_for_the_others():
    bends = [[0.0, 0.0, 0.01], [0.0, 0.01, 0.0], [-0.01, 0.0, 0.0], [-0.04, 0.0, 0.06]]
    assert not bent_together(lessons_of([0.95, 0.94, 0.95, 0.3], bends))


def test_one_camera_alone_has_nobody_to_ask():
    assert not bent_together(lessons_of([0.5], ALIKE[:1]))
    assert not bent_together([])


class Mild:
    """A camera whose tone curve bends so mildly that it does not believe it."""

    def __init__(self):
        scene, name = scene_catalogue()["still"], "cam1"
        renderer, camera = Renderer(scene, name), scene.camera(name)
        values = np.arange(256) / 255
        curve = np.rint(255 * (values - _MILD * np.sin(2 * np.pi * values))).astype(np.uint8)
        self.pictures = [
            (curve[renderer.picture(time_s, k)], cones(scene, camera, time_s))
            for k, time_s in enumerate(TIMES_S)
        ]
        self.learner = learner_of(camera)
        self.now = first_appearance("srgb")

    def see(self, numbers):
        """What is known after these pictures, of which every other one is the same."""
        for number in numbers:
            pixels, balls = self.pictures[number % 2]
            if self.learner.wants(len(balls), number / 30):
                self.now = taught(self.learner, pixels, balls, [], self.now) or self.now
        return self.now

    def hear(self, bent):
        """What is known when it has conferred with itself alone."""
        self.now = self.learner.told(self.now, [self.learner.lesson], bent)
        return self.now


def test_a_camera_that_is_told_believes_the_bend_it_sees_and_goes_on_doing_so():
    camera = Mild()
    assert np.all(np.abs(camera.see(range(1, 9)).bends) < 1e-5)
    assert camera.learner.lesson.left > 0.72
    told = camera.hear(bent=True)
    assert 0.3 * _MILD < told.bends[2] < 2 * _MILD
    assert camera.hear(bent=True) is told, "nothing new"
    assert camera.see(range(9, 33)).bends[2] > 0.3 * _MILD


def test_one_that_is_not_told_goes_on_without():
    assert np.all(np.abs(Mild().see(range(1, 33)).bends) < 1e-5)
