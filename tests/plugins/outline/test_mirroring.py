from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.simulation import Renderer
from measure.simulation.catalogue import plain_scene
from measure.simulation.rooms import plain, room
from measure_plugins._outline.appearance.model import GLOSSY, MATT, first_appearance
from measure_plugins._outline.appearance.radial_basis import radial
from measure_plugins._outline.self_calibration import response_and_blur as appearance_fit
from measure_plugins._outline.self_calibration.response_and_blur import with_or_without_mirroring
from tests.plugins.outline.lessons import lessons

CAMERA = "cam1"
PAINT = (0.06, 0.20, 0.45)


def _painted_room(paint):
    """Glossy balls in a room of one colour, which they mirror."""
    walls = plain(paint)
    return replace(plain_scene("grey", 11), backdrop=room(walls, (walls,)))


def _learn(scene):
    return lessons(scene, CAMERA)[-1]


def test_balls_that_mirror_the_wall_behind_them_are_taken_to():
    learnt = _learn(_painted_room(PAINT))
    assert learnt.index == GLOSSY
    assert learnt.mirrors


def test_balls_that_mirror_something_else_are_not(monkeypatch):
    """As no room could be: what is seen behind the balls is pasted in, and they mirror another."""
    seen = Renderer(_painted_room(PAINT), CAMERA)._backdrop
    monkeypatch.setattr(Renderer, "_backdrop", property(lambda _: seen))
    learnt = _learn(_painted_room((float(np.mean(PAINT)),) * 3))
    assert learnt.index == GLOSSY
    assert not learnt.mirrors


@pytest.mark.parametrize(("told", "believed"), [(0.3, True), (0.06, False), (-0.3, False)])
def test_one_ball_before_another_tells_enough(monkeypatch, told, believed):
    """Five of six sights before black cloth are silent; what the sixth shows decides."""
    worse = dict(enumerate([told, 0.001, -0.002, 0.0, 0.003, 0.0]))
    monkeypatch.setattr(appearance_fit, "telling", lambda sights: sights)
    monkeypatch.setattr(
        appearance_fit, "_plain_misfit", lambda sight, at: np.exp(worse[sight] * at.mirrors)
    )
    start = first_appearance("srgb")
    assert with_or_without_mirroring(list(worse), start).mirrors is not believed


def test_before_black_cloth_nothing_speaks_against_it():
    assert _learn(plain_scene("black", 13)).mirrors


def test_what_is_behind_is_left_out_where_it_is_not_mirrored():
    with_it, without = radial(60.0, 0.045, 1.0, GLOSSY), radial(60.0, 0.045, 1.0, GLOSSY, False)
    assert with_it.nearby.max() > 0.1
    assert np.all(without.nearby == 0)
    assert np.array_equal(with_it.diffuse, without.diffuse)
    assert radial(60.0, 0.045, 1.0, MATT).nearby.max() < 1e-3
