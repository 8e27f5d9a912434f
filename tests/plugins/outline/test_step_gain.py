"""One look leads to where many do, once it is known how much it shows of a displacement."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.simulation.renderer import Renderer
from measure.simulation.sensor import encode
from measure_plugins._outline.fitting.batch import cones_of
from measure_plugins._outline.fitting.outline import fit_look, turned
from measure_plugins._outline.fitting.scan import Search, light_about, look_closely
from measure_plugins._outline.fitting.step_gain import CORRECTED_GROWTH, measured_gain, restore
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of
from tests.simulated.catalogue import scene_catalogue

_ASIDE_PX = 0.3
_UNKNOWN = np.eye(2)
_NO_LAMPS_MM = 300.0  # only lamps ask how far a ball is, and there are none


def sight(camera_name):
    """A picture before a cluttered background: body, camera, picture and the balls' centres, mm."""
    scene = scene_catalogue()["plain-clutter"]
    camera = scene.camera(camera_name)
    picture = Renderer(scene, camera_name).picture(0.0, 0)
    data = np.frombuffer(encode(picture, scene.sensor_of(camera_name)), "u1")
    image = image_of(camera, cv2.imdecode(data, cv2.IMREAD_COLOR))
    centers = np.stack([ball.center_mm for ball in scene.body.balls])
    (pose,) = scene.trajectory.at(np.array([0.0]))
    seen = camera.world_from_camera.inverse().apply(pose.apply(centers))
    return scene.body, camera, image, seen


@pytest.fixture(scope="module")
def scene_view():
    return sight("cam0")


@pytest.fixture(scope="module")
def balls(scene_view):
    """For every ball: its settled search, the picture, and what the model says it shows."""
    body, camera, image, seen = scene_view
    detector = OutlineDetector(OutlineConfig(self_calibrate=False), body, camera)
    radii = np.array([ball.radius_mm for ball in body.balls])
    view, cones = detector._view(image), cones_of(seen, radii, camera.intrinsics.row)
    out = []
    for axis, half_angle, size_px in zip(cones[:, :3], cones[:, 3], cones[:, 5], strict=True):
        radial = detector._appearance.tables(size_px, half_angle)
        for _ in range(12):
            axis, _ = looked(view, axis, half_angle, radial, _UNKNOWN)
        out.append((view, search_for(axis, half_angle), radial))
    return out


def search_for(axis, half_angle, gain=_UNKNOWN):
    none = np.empty((0, 4))
    return Search(axis, half_angle, none, none, 0.0, 72, 0.06, 7.0, _NO_LAMPS_MM, gain)


def looked(view, axis, half_angle, radial, gain):
    """The axis that one look leads to, and the look."""
    search = search_for(axis, half_angle)
    ambient = light_about(view, search, axis, radial)
    look = look_closely(view, search, axis, half_angle, radial, ambient)
    fit = fit_look(look, CORRECTED_GROWTH, False)
    restore(look, fit, gain)
    return turned(look, fit), look


def off_after_one_look(balls, gains):
    """How far looks from around lead past the settled outlines, RMS in px."""
    off = []
    for (view, search, radial), gain in zip(balls, gains, strict=True):
        _, look = looked(view, search.axis, search.half_angle, radial, gain)
        px_per_rad = float(np.mean(look.scale))
        for angle in np.radians([20, 110, 200, 290]):
            aside = np.cos(angle) * look.frame[0] + np.sin(angle) * look.frame[1]
            start = search.axis + _ASIDE_PX / px_per_rad * aside
            axis, _ = looked(view, start / np.linalg.norm(start), search.half_angle, radial, gain)
            off.append(px_per_rad * np.linalg.norm(axis - search.axis))
    return float(np.sqrt(np.mean(np.square(off))))


def test_with_the_gain_one_look_does_what_takes_several_without(balls):
    unknown = off_after_one_look(balls, [_UNKNOWN] * len(balls))
    known = off_after_one_look(balls, [measured_gain(*ball) for ball in balls])
    assert unknown > 0.1
    assert known < 0.65 * unknown


def test_little_is_made_of_a_look_that_hardly_answers(balls):
    """A ball whose picture is all model: shaded so evenly that no displacement shows."""
    view, search, radial = balls[0]
    blank = view._replace(pixels=np.full_like(view.pixels, 128))
    np.testing.assert_array_equal(measured_gain(blank, search, radial), _UNKNOWN)


def test_edges_move_with_the_axis(balls):
    view, search, radial = balls[0]
    gain = np.array([[1.5, 0.2], [0.1, 1.3]])
    start = search.axis + 0.4e-3 * np.array([1.0, 0.0, 0.0])
    start /= np.linalg.norm(start)
    _, plain = looked(view, start, search.half_angle, radial, _UNKNOWN)
    before = fit_look(plain, CORRECTED_GROWTH, False)
    _, moved = looked(view, start, search.half_angle, radial, gain)
    after = fit_look(moved, CORRECTED_GROWTH, False)
    np.testing.assert_allclose(after.solution[:2], gain @ before.solution[:2], atol=2e-3)
    assert after.solution[2] == pytest.approx(before.solution[2], abs=2e-3)


def test_detections_do_not_lean_towards_their_predictions():
    """Twice the same picture, predicted from either side: a look each, and the same centres.

    One camera's picture tells little: how much balls lean differs from picture to picture.
    """
    leanings = [_leaning(*sight(f"cam{k}")) for k in range(4)]
    assert np.sqrt(np.mean(np.square(leanings))) < 0.15


def _leaning(body, camera, image, seen):
    """How far apart centres come out, as a share of how far apart they were predicted."""
    detector = OutlineDetector(OutlineConfig(self_calibrate=False), body, camera)
    found = []
    for offset in np.array([[0.08, 0.0, 0.0], [-0.08, 0.0, 0.0]]):
        expected = [
            expect(camera, ball.name, center, ball.radius_mm, 4.0, offset)
            for ball, center in zip(body.balls, seen, strict=True)
        ]
        detector.detect(image, expected)
        found.append([d.center_px for d in detector.detect(image, expected)])
    apart = np.array(found[0]) - np.array(found[1])
    predicted_apart = 0.16 * camera.intrinsics.focal_px / seen[:, 2].mean()
    assert predicted_apart > 0.3
    return np.sqrt(np.mean(apart**2)) / predicted_apart
