"""One scan leads to where many do, once the step gain is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.simulation.sensor import encode
from measure_plugins._outline.fitting.batch import cones_of
from measure_plugins._outline.fitting.measurement import (
    CORRECTED_GROWTH,
    apply_step_gain,
    measure_step_gain,
)
from measure_plugins._outline.fitting.scan import (
    OutlineSearch,
    ambient_light,
    corrected_axis,
    fit_scan,
    scan_with_model,
)
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import expect, image_of
from tests.plugins.rendering import picture, scenes

_OFFSET_PX = 0.3
_UNKNOWN = np.eye(2)
_NO_LIGHTS_MM = 300.0  # only point lights need the distance, and there are none


def view_of(camera_name):
    """Body, camera, picture with a cluttered background, and the balls' centres in mm."""
    scene = scenes()["plain-clutter"]
    camera = scene.camera(camera_name)
    pixels = picture(scene, camera_name, 0.0)
    data = np.frombuffer(encode(pixels, scene.sensor_of(camera_name)), "u1")
    image = image_of(camera, cv2.imdecode(data, cv2.IMREAD_COLOR))
    centers = np.stack([ball.center_mm for ball in scene.body.balls])
    (pose,) = scene.trajectory.at(np.array([0.0]))
    seen = camera.world_from_camera.inverse().apply(pose.apply(centers))
    return scene.body, camera, image, seen


@pytest.fixture(scope="module")
def scene_view():
    return view_of("cam0")


@pytest.fixture(scope="module")
def balls(scene_view):
    """For every ball: the picture, its converged search, and its tables."""
    body, camera, image, seen = scene_view
    detector = OutlineDetector(OutlineConfig(self_calibrate=False), body, camera)
    radii = np.array([ball.radius_mm for ball in body.balls])
    view, cones = detector._view(image), cones_of(seen, radii, camera.intrinsics.row)
    out = []
    for axis, half_angle, size_px in zip(cones[:, :3], cones[:, 3], cones[:, 5], strict=True):
        tables = detector._appearance.tables(size_px, half_angle)
        for _ in range(12):
            axis, _ = scanned(view, axis, half_angle, tables, _UNKNOWN)
        out.append((view, search_for(axis, half_angle), tables))
    return out


def search_for(axis, half_angle, step_gain=_UNKNOWN):
    none = np.empty((0, 4))
    return OutlineSearch(axis, half_angle, none, none, 0.0, 72, 0.06, 7.0, _NO_LIGHTS_MM, step_gain)


def scanned(view, axis, half_angle, tables, step_gain):
    """The axis that one scan leads to, and the scan."""
    search = search_for(axis, half_angle)
    ambient = ambient_light(view, search, axis, tables)
    scan = scan_with_model(view, search, axis, half_angle, tables, ambient)
    fit = fit_scan(scan, CORRECTED_GROWTH, False)
    apply_step_gain(scan, fit, step_gain)
    return corrected_axis(scan, fit), scan


def off_after_one_scan(balls, step_gains):
    """RMS distance in px of single scans from around to the converged outlines."""
    off = []
    for (view, search, tables), step_gain in zip(balls, step_gains, strict=True):
        _, scan = scanned(view, search.axis, search.half_angle, tables, step_gain)
        px_per_rad = float(np.mean(scan.scale))
        for angle in np.radians([20, 110, 200, 290]):
            offset = np.cos(angle) * scan.frame[0] + np.sin(angle) * scan.frame[1]
            start = search.axis + _OFFSET_PX / px_per_rad * offset
            axis, _ = scanned(
                view, start / np.linalg.norm(start), search.half_angle, tables, step_gain
            )
            off.append(px_per_rad * np.linalg.norm(axis - search.axis))
    return float(np.sqrt(np.mean(np.square(off))))


def test_one_scan_with_the_step_gain_replaces_several(balls):
    unknown = off_after_one_scan(balls, [_UNKNOWN] * len(balls))
    known = off_after_one_scan(balls, [measure_step_gain(*ball) for ball in balls])
    assert unknown > 0.1
    assert known < 0.65 * unknown


def test_step_gain_of_a_picture_without_response_is_one(balls):
    """A ball whose picture is all model: shaded so evenly that no displacement shows."""
    view, search, tables = balls[0]
    blank = view._replace(pixels=np.full_like(view.pixels, 128))
    np.testing.assert_array_equal(measure_step_gain(blank, search, tables), _UNKNOWN)


def test_edges_move_with_the_axis(balls):
    view, search, tables = balls[0]
    step_gain = np.array([[1.5, 0.2], [0.1, 1.3]])
    start = search.axis + 0.4e-3 * np.array([1.0, 0.0, 0.0])
    start /= np.linalg.norm(start)
    _, plain = scanned(view, start, search.half_angle, tables, _UNKNOWN)
    before = fit_scan(plain, CORRECTED_GROWTH, False)
    _, moved = scanned(view, start, search.half_angle, tables, step_gain)
    after = fit_scan(moved, CORRECTED_GROWTH, False)
    np.testing.assert_allclose(after.solution[:2], step_gain @ before.solution[:2], atol=2e-3)
    assert after.solution[2] == pytest.approx(before.solution[2], abs=2e-3)


def test_detections_do_not_lean_towards_their_predictions():
    """Twice the same picture, predicted from either side: a scan each, and the same centres.

    One camera's picture tells little: how much balls lean differs from picture to picture.
    """
    leanings = [_leaning(*view_of(f"cam{k}")) for k in range(4)]
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
