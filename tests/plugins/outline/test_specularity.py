from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.model import Intrinsics
from measure.simulation.catalogue import PLASTIC, webcam_scene
from measure_plugins._outline.appearance.model import GLOSSY, tone_table
from measure_plugins._outline.appearance.model import MATT as MATT_INDEX
from measure_plugins._outline.self_calibration import response_and_blur as appearance_fit
from measure_plugins._outline.self_calibration.specularity import highlights
from tests.plugins.outline.estimates import estimates
from tests.simulated.catalogue import MATT

SIZE, CENTER, RADIUS = 101, np.array([50.0, 50.0]), 40.0
ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
OUTLINE = CENTER + RADIUS * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
CLEAR = np.ones(len(ANGLES), bool)
RED, WHITE = np.array([20, 15, 160]), np.array([150, 150, 150])
LIGHT = tone_table("srgb")


def _ball(color, spot_px=0.0, spot_at=(60, 40), noise=3.0):
    """A ball shaded from left to right, with a white spot on it, before black."""
    v, u = np.indices((SIZE, SIZE))
    picture = (color * (0.4 + 0.6 * u / SIZE)[..., None]) * (
        np.hypot(u - CENTER[0], v - CENTER[1]) < RADIUS
    )[..., None]
    picture[np.hypot(u - spot_at[0], v - spot_at[1]) < spot_px] = 255
    picture = picture + np.random.default_rng(0).normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def test_a_lights_spot_counts_and_noise_and_shade_do_not():
    assert highlights([(_ball(RED, 4.0), OUTLINE, CLEAR)], LIGHT) > 0.5
    assert highlights([(_ball(RED), OUTLINE, CLEAR)], LIGHT) < 0.1


def test_a_white_ball_has_no_measurable_highlight():
    assert np.isnan(highlights([(_ball(WHITE, 4.0), OUTLINE, CLEAR)], LIGHT))
    assert np.isnan(highlights([], LIGHT))


def test_what_stands_in_front_of_a_ball_does_not_count():
    shown = _ball(RED, 6.0, spot_at=(80, 50))
    hidden = CLEAR & (np.abs(np.angle(np.exp(1j * ANGLES))) > 0.5)
    assert highlights([(shown, OUTLINE, CLEAR)], LIGHT) > 0.5
    assert highlights([(shown, OUTLINE, hidden)], LIGHT) < 0.1
    assert np.isnan(highlights([(shown, OUTLINE, ~CLEAR)], LIGHT))


def test_one_ball_of_three_does_not_decide():
    balls = [(_ball(RED, spot), OUTLINE, CLEAR) for spot in (0.0, 5.0, 0.0)]
    assert highlights(balls, LIGHT) < 0.1


def _small_pictures():
    """Half as many pixels each way, as from a 640x480 camera."""
    scene = webcam_scene(24)
    half = np.diag([0.5, 0.5, 1.0])
    lenses = [camera.intrinsics for camera in scene.cameras]
    smaller = [Intrinsics((640, 360), half @ lens.matrix, lens.distortion) for lens in lenses]
    pairs = zip(scene.cameras, smaller, strict=True)
    return replace(scene, cameras=tuple(replace(c, intrinsics=lens) for c, lens in pairs))


def _sharpened(finish):
    scene = webcam_scene(12)
    return replace(scene, sensor=replace(scene.sensor, tone="2.2", sharpen=0.8), finish=finish)


def _estimated_index(scene, camera):
    return estimates(scene, camera)[1].index


def _without_highlights(monkeypatch):
    monkeypatch.setattr(appearance_fit, "highlights", lambda *_: np.nan)


def test_glossy_balls_in_small_pictures_are_not_taken_for_matt_ones(monkeypatch):
    cameras = ("cam0", "cam1", "cam2", "cam3")
    scene = _small_pictures()
    assert {_estimated_index(scene, camera) for camera in cameras} == {GLOSSY}
    _without_highlights(monkeypatch)
    by_prediction = {_estimated_index(scene, camera) for camera in cameras}
    assert MATT_INDEX in by_prediction, "predictions alone mistake them"


@pytest.mark.parametrize(("finish", "index"), [(MATT, MATT_INDEX), (PLASTIC, GLOSSY)])
def test_the_surface_is_found_where_pictures_are_sharpened(finish, index):
    assert _estimated_index(_sharpened(finish), "cam1") == index


def test_without_highlights_the_glossy_model_must_be_clearly_better(monkeypatch):
    """Of sharpened pictures of matt paint it left 0.8 to 0.87 of what the matt one did."""
    monkeypatch.setattr(appearance_fit, "_share", lambda *_: 0.86)
    assert _estimated_index(_sharpened(MATT), "cam1") == MATT_INDEX
    assert _estimated_index(_sharpened(PLASTIC), "cam1") == GLOSSY
    _without_highlights(monkeypatch)
    assert _estimated_index(_sharpened(MATT), "cam1") == GLOSSY
