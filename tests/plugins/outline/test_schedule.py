"""Which pictures of a recording are lessons."""

from __future__ import annotations

from measure.simulation import Renderer
from measure_plugins._outline.appearance.model import first_appearance
from tests.plugins.outline.lessons import cones, learner_of
from tests.simulated.catalogue import scene_catalogue


def lessons_of(learner, scene, camera_name, pictures):
    """Those of the numbered pictures that teach something; one picture stands for all."""
    camera = scene.camera(camera_name)
    pixels, balls = Renderer(scene, camera_name).picture(0.0, 0), cones(scene, camera, 0.0)
    out = []
    for number in pictures:
        if learner.wants(len(balls), number / 30):
            now = first_appearance("srgb")
            if learner.shown(pixels, balls[:1], balls[1:], now) is not None:
                out.append(number)
    return out


def test_pictures_that_come_again_teach_nothing_again():
    scene = scene_catalogue()["still"]
    learner = learner_of(scene.camera("cam1"))
    assert lessons_of(learner, scene, "cam1", range(1, 8)) == [2]
    assert not learner.settled
    assert lessons_of(learner, scene, "cam1", range(8, 9)) == [8]
    assert learner.settled
    assert lessons_of(learner, scene, "cam1", range(1, 40)) == [32]
    assert lessons_of(learner, scene, "cam1", range(40)) == []


def test_of_a_short_rehearsal_the_lesson_that_is_left_comes_in_its_turn():
    scene = scene_catalogue()["still"]
    learner = learner_of(scene.camera("cam1"))
    assert lessons_of(learner, scene, "cam1", range(1, 6)) == [2]
    assert lessons_of(learner, scene, "cam1", range(1, 10)) == [8]
