"""Scenes in other light are the catalogue's, but for what a seed decides."""

from __future__ import annotations

import numpy as np
import pytest

from tests.simulated.catalogue import relit_scenes, scene_catalogue

USUAL, RELIT = scene_catalogue(), relit_scenes()


def lamps(scene) -> list[list[float]]:
    return [list(lamp.position_mm) for lamp in scene.lighting.lights]


def test_each_is_a_usual_scene_under_lamps_of_its_own() -> None:
    kinds = {name: name.rsplit(" ", 1)[0] for name in RELIT}
    assert set(kinds.values()) < set(USUAL)
    assert len(RELIT) == 4 * len(set(kinds.values()))
    for name, scene in RELIT.items():
        usual = USUAL[kinds[name]]
        others = [one for one in RELIT if kinds[one] == kinds[name] and one != name]
        assert scene.name == name
        assert scene.body.names == usual.body.names
        for other in (usual, *(RELIT[one] for one in others)):
            assert scene.seed != other.seed
            assert lamps(scene) != lamps(other)


@pytest.mark.parametrize("name", RELIT)
def test_every_ball_is_in_sight_of_two_cameras(name) -> None:
    scene = RELIT[name]
    for pose in scene.trajectory.at(np.array([0.0, 0.25])):
        for ball in scene.body.balls:
            at = pose.apply(ball.center_mm)[None]
            assert sum(bool(c.intrinsics.contains(c.project(at))[0]) for c in scene.cameras) >= 2
