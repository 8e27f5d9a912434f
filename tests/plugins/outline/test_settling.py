"""Iterations that oscillate converge, because a step back is halved.

A step gain is measured once and may since have changed: where it is nearly twice too large, each
scan leads about as far off on the other side.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.simulation.renderer import Renderer
from measure.simulation.sensor import encode
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of
from tests.simulated.catalogue import scene_catalogue

_FRAMES = range(4)
_FALSE_GAIN = 1.8


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


def test_outlines_converge_though_scans_overshoot(views):
    detector, pictures = views
    found = [[d.ball for d in detector.detect(image, expected)] for image, expected in pictures]
    assert found == [["green", "yellow", "red"]] * len(_FRAMES)
