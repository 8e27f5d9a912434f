"""Scenes and pictures of them, each made once and shared by the tests of a process."""

from __future__ import annotations

from functools import cache, lru_cache

from measure.simulation import Renderer
from measure.simulation.catalogue import plain_scene
from tests.simulated.catalogue import cluttered_scene, relit_scenes, scene_catalogue
from tests.simulated.mirroring import mirrored

relit = cache(relit_scenes)
scenes = cache(scene_catalogue)
plain = cache(plain_scene)
cluttered = cache(cluttered_scene)


@lru_cache(maxsize=4)
def _renderer(scene, camera_name):
    return Renderer(mirrored(scene), camera_name)


@lru_cache(maxsize=32)
def picture(scene, camera_name, time_s, number=0):
    """Pixels (h, w, 3) of a picture with the noise of this number; do not write to them."""
    return _renderer(scene, camera_name).picture(time_s, number)
