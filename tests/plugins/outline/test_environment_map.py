from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.simulation import Renderer
from measure_plugins._outline.appearance.environment_map import (
    EnvironmentMap,
    environment_reflection,
    no_environment,
)
from measure_plugins._outline.appearance.model import GLOSSY, tone_table
from measure_plugins._outline.appearance.radial_basis import DEFLECTIONS, radial_tables
from measure_plugins._outline.sampling.rays import STEPS, angles_around, frame_about
from measure_plugins._outline.self_calibration.environment_map import background_of, environment_of
from tests.plugins.outline.estimates import cones, estimates
from tests.plugins.rendering import cluttered, picture, plain

CAMERA = "cam3"
HALF_ANGLE = 0.045
AXIS = np.array([0.0, 0.0, 1.0])
BLUE = np.array([0.2, -0.1, -0.1])
TABLES = radial_tables(60.0, HALF_ANGLE, 1.0, GLOSSY)


def _mirrored(colors, share=0.5):
    """What a ball in the middle of a view 2 x 2 wide mirrors (3, m, 36) of these colours."""
    step = 2 / colors.shape[0]
    environment = EnvironmentMap(
        colors, np.full(2, step / 2 - 1), step, np.full(4, share), np.ones(4)
    )
    return environment_reflection(
        environment, TABLES.grey, frame_about(AXIS), HALF_ANGLE, angles_around(36)
    )


def test_an_unknown_map_is_not_mirrored():
    frame, around = frame_about(AXIS), angles_around(36)
    assert (
        environment_reflection(no_environment(), TABLES.grey, frame, HALF_ANGLE, around).size == 0
    )


def test_a_grey_map_adds_no_colour():
    assert np.all(_mirrored(np.zeros((40, 40, 3))) == 0)


def test_a_map_of_one_colour_extends_the_grazing_reflection():
    """Just inside the outline as grazing reflection; deeper, where that fades, as the map."""
    mirrored = _mirrored(np.tile(BLUE, (40, 40, 1)))
    whole = mirrored[0] + BLUE[0] * TABLES.grazing_reflection[:, None]
    seen = BLUE[0] * TABLES.grey[:, :-1].sum(axis=1)
    assert np.allclose(whole[STEPS > -6.0], seen[STEPS > -6.0, None], atol=0.002)


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_an_object_is_mirrored_on_its_side_at_its_angle(share):
    colors, at = np.zeros((80, 80, 3)), np.tan(HALF_ANGLE + share * DEFLECTIONS[2])
    column = round((at + 1) * 40 - 0.5)
    colors[38:42, column - 1 : column + 2] = BLUE
    mirrored = _mirrored(colors, share)[0]
    sides = angles_around(36) @ frame_about(AXIS)[:2, :2]
    shown = mirrored.sum(axis=0)
    assert np.all(shown[sides[:, 0] < 0.5] == 0)
    brightest = int(np.argmax(shown))
    assert sides[brightest, 0] > 0.95
    ratio = mirrored[:, brightest] @ TABLES.grey[:, 2]
    ratio /= np.linalg.norm(mirrored[:, brightest]) * np.linalg.norm(TABLES.grey[:, 2])
    assert ratio > 0.95, "not where the ball turns the line of sight by that angle"


def test_colours_end_gradually_at_the_pictures_border():
    """A ball that moves must not see them vanish at once."""
    colors = np.tile(BLUE, (40, 40, 1))
    turns = np.linspace(0.5, 1.1, 61)
    values = []
    for turn in turns:
        frame = frame_about(np.array([np.sin(turn), 0.0, np.cos(turn)]))
        environment = EnvironmentMap(
            colors, np.full(2, 0.025 - 1), 0.05, np.full(4, 0.5), np.ones(4)
        )
        around = np.array([[frame[0, 0], frame[1, 0]]]) / np.hypot(frame[0, 0], frame[1, 0])
        values.append(
            environment_reflection(environment, TABLES.grey, frame, HALF_ANGLE, around)[
                0, :, 0
            ].sum()
        )
    steps = np.abs(np.diff(values))
    assert np.ptp(values) > 0.05
    assert steps.max() < 0.2 * np.ptp(values)


def test_balls_are_left_out_of_the_map():
    scene = plain("grey", 3)
    camera = scene.camera(CAMERA)
    balls = np.array([[*axis, half] for axis, half, _ in cones(scene, camera, 0.0)])
    pixels = picture(scene, CAMERA, 0.0)
    table = tone_table("srgb")
    without = background_of(pixels, camera.intrinsics.row, balls)
    with_them = background_of(pixels, camera.intrinsics.row, np.empty((0, 4)))
    environment = environment_of([without], table)
    assert environment.colors.shape[1] == 80
    assert np.abs(environment.colors).max() < 0.02, "grey cloth has no colour"
    assert np.abs(environment_of([with_them], table).colors).max() > 0.1
    everywhere = np.array([[*AXIS, 2.0]])
    nothing = background_of(pixels, camera.intrinsics.row, everywhere)
    assert environment_of([nothing], table).colors.size == 0


def test_the_map_is_used_where_balls_mirror_it():
    scene = cluttered(21)
    estimated_appearance = estimates(scene, CAMERA)[-1]
    assert estimated_appearance.environment.colors.size > 0


def test_a_map_that_balls_do_not_mirror_is_not_used(monkeypatch):
    """As no room could be: what is seen behind the balls is pasted in, and they mirror another."""
    scene = cluttered(21)
    seen = Renderer(scene, CAMERA)._backdrop
    monkeypatch.setattr(Renderer, "_backdrop", property(lambda _: seen))
    other = estimates(replace(scene, backdrop=plain("grey", 21).backdrop), CAMERA)[-1]
    assert other.environment.colors.size == 0


def test_a_map_without_colour_is_not_used():
    assert estimates(plain("grey", 3), CAMERA)[-1].environment.colors.size == 0
