from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure_plugins._outline.appearance.model import (
    GLOSSY,
    MATT,
    bent_table,
    first_appearance,
    tone_table,
)
from tests.plugins.outline.estimates import TIMES_S, calibration_of, cones, estimated, estimates
from tests.plugins.rendering import picture, scenes

CAMERA = "cam1"


@pytest.fixture(scope="module")
def estimated_appearance():
    """Estimates from two pictures of each scene by one camera."""
    return {name: _estimated(name) for name in ("still", "sharpened", "matt")}


def _estimated(name):
    first, second = estimates(scenes()[name], CAMERA)
    assert first is None, "the first picture is only kept"
    return second


def test_a_standard_camera_and_glossy_balls_are_left_as_they_are(estimated_appearance):
    assert estimated_appearance["still"].index == GLOSSY
    assert np.all(np.abs(estimated_appearance["still"].bends) < 1e-6)
    assert 0.8 < estimated_appearance["still"].blur_px < 1.3


def test_a_bent_tone_curve_is_found(estimated_appearance):
    true = _true_table("sharpened")
    seen = slice(20, 160)  # the values that the balls before black cloth show
    before, after = (
        _off(table[seen], true[seen])
        for table in (tone_table("srgb"), estimated_appearance["sharpened"].table)
    )
    assert estimated_appearance["sharpened"].index == GLOSSY
    assert after < 0.5 * before


def test_a_mild_bend_is_found_with_point_lights():
    """Half as strong an S as above: free shading explains it nearly as well."""
    strength = 0.06

    def contrasty(_, pixels, balls):
        values = np.arange(256) / 255
        curve = np.rint(255 * (values - strength * np.sin(2 * np.pi * values)))
        return curve.astype(np.uint8)[pixels], balls

    estimated = estimates(scenes()["still"], "cam3", contrasty)[1]
    assert 0.3 * strength < estimated.bends[2] < 1.2 * strength


def test_matt_paint_is_found(estimated_appearance):
    assert estimated_appearance["matt"].index == MATT
    assert np.all(np.abs(estimated_appearance["matt"].bends) < 1e-6)


def _true_table(name):
    """Light (256,) of each picture value of the scene's camera."""
    from measure.simulation.sensor import tone_curve

    levels = tone_curve(scenes()[name].sensor_of(CAMERA).tone)
    return np.interp(np.arange(256), levels, np.linspace(0, 1, len(levels)))


def _off(table, true):
    """Relative RMS error of a table; its scale means nothing."""
    scale = (table @ true) / (table @ table)
    return np.sqrt(np.mean((np.log(scale * table + 1e-4) - np.log(true + 1e-4)) ** 2))


@pytest.mark.parametrize("bends", [(0, 0, 0), (0.05, -0.1, 0.05), (-0.05, 0.1, -0.05), (0, 0, 0.3)])
def test_tables_rise_from_0_to_1(bends):
    table = bent_table("srgb", np.array(bends, dtype=float))
    assert np.all(np.diff(table) >= 0)
    assert table[255] == pytest.approx(1.0)
    assert table[0] < 0.01
    assert np.allclose(bent_table("srgb", np.zeros(3)), tone_table("srgb"), atol=1e-3)


def test_too_few_balls_give_no_estimate():
    scene = replace(scenes()["still"], shown=("red",))
    camera = scene.camera(CAMERA)
    calibration = calibration_of(camera)
    start = first_appearance("srgb")
    for k, time_s in enumerate(TIMES_S):
        red = cones(scene, camera, time_s)[scene.body.index("red")]
        assert calibration.wants_image(1, time_s)
        estimated_appearance = estimated(
            calibration, picture(scene, CAMERA, time_s, k), [red], [], start
        )
    assert estimated_appearance is start
