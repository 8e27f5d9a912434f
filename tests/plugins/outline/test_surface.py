"""Glossy or matt balls, by the misfit of pictures predicted with either surface."""

from __future__ import annotations

from dataclasses import replace

import pytest

from measure.simulation.catalogue import webcam_scene
from measure.simulation.presets import MATT, PLASTIC
from measure_plugins._outline.appearance.model import GLOSSY
from measure_plugins._outline.appearance.model import MATT as MATT_INDEX
from tests.plugins.outline.estimates import estimates


@pytest.mark.parametrize(("finish", "index"), [(MATT, MATT_INDEX), (PLASTIC, GLOSSY)])
def test_the_surface_is_found_where_pictures_are_sharpened(finish, index):
    scene = webcam_scene(12)
    sharpened = replace(scene.sensor, tone="2.2", sharpen=0.8)
    scene = replace(scene, sensor=sharpened, finish=finish)
    assert estimates(scene, "cam1")[1].index == index
