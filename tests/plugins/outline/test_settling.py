"""Iterations that oscillate converge, because a step back is halved.

A step gain is measured once and may since have changed: where it is nearly twice too large, each
scan leads about as far off on the other side.
"""

from __future__ import annotations

import inspect

import cv2
import numba
import numpy as np
import pytest

from measure.simulation.renderer import Renderer
from measure.simulation.sensor import encode
from measure_plugins._outline.fitting import batch as balls
from measure_plugins._outline.fitting import measurement
from measure_plugins.detectors import _known_balls
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of
from tests.simulated.catalogue import scene_catalogue

_FRAMES = range(4)
_HALVING = "step *= 0.5"
_FALSE_GAIN = 1.8


def without_halving():
    """`measure_balls` that steps back as far as it came."""
    source = inspect.getsource(measurement._iterate_corrected.py_func)
    assert source.count(_HALVING) == 1
    iterate = _compiled(measurement, source.replace(_HALVING, "step *= 1.0"), "_iterate_corrected")
    source = inspect.getsource(measurement.measure_known_size.py_func)
    closely = _compiled(measurement, source, "measure_known_size", _iterate_corrected=iterate)
    source = inspect.getsource(balls.measure_balls.py_func)
    return _compiled(balls, source, "measure_balls", measure_known_size=closely)


def _compiled(module, source, name, **other):
    names = {**vars(module), **other}
    exec(source[source.index("def ") :], names)
    return numba.njit(nogil=True, error_model="numpy")(names[name])


@pytest.fixture(scope="module")
def views():
    """One camera's pictures of the sharpened scene, with what is expected in each."""
    scene = scene_catalogue()["sharpened"]
    (camera,) = (c for c in scene.cameras if c.name == "cam0")
    renderer, times = Renderer(scene, "cam0"), np.array(_FRAMES) / 30
    centers = np.stack([ball.center_mm for ball in scene.body.balls])
    out = []
    for k, pose in zip(_FRAMES, scene.trajectory.at(times), strict=True):
        data = np.frombuffer(encode(renderer.picture(times[k], k), scene.sensor_of("cam0")), "u1")
        seen = camera.world_from_camera.inverse().apply(pose.apply(centers))
        expected = [
            expect(camera, ball.name, center, ball.radius_mm, 4.0, (0.5, -0.5, 0.2))
            for ball, center in zip(scene.body.balls, seen, strict=True)
        ]
        out.append((image_of(camera, cv2.imdecode(data, cv2.IMREAD_COLOR)), expected))
    detector = OutlineDetector(OutlineConfig(self_calibrate=False), scene.body, camera)
    detector._balls.set_step_gains(
        {ball.name: _FALSE_GAIN * np.eye(2) for ball in scene.body.balls}
    )
    return detector, out


def measured(views):
    detector, pictures = views
    return [[d.ball for d in detector.detect(image, expected)] for image, expected in pictures]


def test_outlines_converge_though_scans_overshoot(views):
    assert measured(views) == [["green", "yellow", "red"]] * len(_FRAMES)


@pytest.mark.slow
def test_without_halved_steps_some_never_do(views, monkeypatch):
    """The negative control: without it, the test above would fail."""
    monkeypatch.setattr(_known_balls, "measure_balls", without_halving())
    missing = 3 * len(_FRAMES) - sum(map(len, measured(views)))
    assert missing > 0
