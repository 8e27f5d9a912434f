from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.simulation import Renderer
from measure.simulation.catalogue import plain_scene, room
from measure_plugins._outline.appearance.model import GLOSSY, MATT, first_appearance
from measure_plugins._outline.appearance.radial_basis import radial_tables
from measure_plugins._outline.self_calibration import response_and_blur as appearance_fit
from measure_plugins._outline.self_calibration.response_and_blur import choose_grazing_reflection
from tests.plugins.outline.estimates import estimates
from tests.simulated.rooms import plain

CAMERA = "cam1"
PAINT = (0.06, 0.20, 0.45)


def _painted_room(paint):
    """Glossy balls in a room of one colour, which they mirror."""
    walls = plain(paint)
    return replace(plain_scene("grey", 11), backdrop=room(walls, (walls,)))


def _estimated(scene):
    return estimates(scene, CAMERA)[-1]


def test_balls_that_mirror_the_wall_behind_them_are_taken_to():
    estimated_appearance = _estimated(_painted_room(PAINT))
    assert estimated_appearance.index == GLOSSY
    assert estimated_appearance.mirrors


def test_balls_that_mirror_something_else_are_not(monkeypatch):
    """As no room could be: what is seen behind the balls is pasted in, and they mirror another."""
    seen = Renderer(_painted_room(PAINT), CAMERA)._backdrop
    monkeypatch.setattr(Renderer, "_backdrop", property(lambda _: seen))
    estimated_appearance = _estimated(_painted_room((float(np.mean(PAINT)),) * 3))
    assert estimated_appearance.index == GLOSSY
    assert not estimated_appearance.mirrors


@pytest.mark.parametrize(("evidence", "mirrored"), [(0.3, True), (0.06, False), (-0.3, False)])
def test_one_ball_in_front_of_another_is_evidence_enough(monkeypatch, evidence, mirrored):
    """Five of six patches, in front of black cloth, show nothing; the sixth decides."""
    worse = dict(enumerate([evidence, 0.001, -0.002, 0.0, 0.003, 0.0]))
    monkeypatch.setattr(appearance_fit, "useful_patches", lambda patches: patches)
    monkeypatch.setattr(
        appearance_fit, "_plain_misfit", lambda patch, at: np.exp(worse[patch] * at.mirrors)
    )
    start = first_appearance("srgb")
    assert choose_grazing_reflection(list(worse), start).mirrors is not mirrored


def test_before_black_cloth_nothing_speaks_against_it():
    assert _estimated(plain_scene("black", 13)).mirrors


def test_what_is_behind_is_left_out_where_it_is_not_mirrored():
    with_it, without = (
        radial_tables(60.0, 0.045, 1.0, GLOSSY),
        radial_tables(60.0, 0.045, 1.0, GLOSSY, False),
    )
    assert with_it.grazing_reflection.max() > 0.1
    assert np.all(without.grazing_reflection == 0)
    assert np.array_equal(with_it.diffuse, without.diffuse)
    assert radial_tables(60.0, 0.045, 1.0, MATT).grazing_reflection.max() < 1e-3
