"""Windows that reach further than a ball's radius, as those of bodies seen a few times a second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure_plugins.detectors._known_balls import lost_in_wide_windows, moved_to_circles
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import BGR, draw, expect, image_of, to_picture
from tests.scenes import LENS, RAVEN

BALLS = {
    "green": np.array([-38.0, -6.0, 420.0]),
    "yellow": np.array([2.0, 20.0, 440.0]),
    "red": np.array([36.0, -8.0, 410.0]),
}
OFF_MM = (27.0, -10.0, 4.0)
"""Some 68 px, where balls have a radius of 48."""


@pytest.fixture(scope="module")
def camera():
    matrix = np.array([[1000.0, 0, 318.0], [0, 1003.0, 242.0], [0, 0, 1]])
    return Camera("cam0", Intrinsics((640, 480), matrix, LENS), RigidTransform.identity())


@pytest.fixture(scope="module")
def detector(camera):
    return OutlineDetector(OutlineConfig(self_calibrate=False), RAVEN, camera)


def picture(camera, shown=tuple(BALLS), also=()):
    """The balls `shown`, and others of (color, centre in mm, radius in mm)."""
    drawn = [(BGR[name], BALLS[name], 20.0) for name in shown]
    drawn += [(BGR[color], np.array(center), radius) for color, center, radius in also]
    colors, centers, radii = zip(*drawn, strict=True)
    return image_of(camera, to_picture(draw(camera, centers, radii, colors)))


def expected(camera, reach_px, shift=OFF_MM):
    return [expect(camera, n, c, 20.0, reach_px=reach_px, shift=shift) for n, c in BALLS.items()]


def errors_px(camera, found):
    return {
        d.ball: float(np.linalg.norm(d.center_px - camera.project(BALLS[d.ball][None])[0]))
        for d in found
    }


def test_balls_beside_their_predictions_are_found_and_measured_as_well_as_others(camera, detector):
    image = picture(camera)
    far = errors_px(camera, detector.detect(image, expected(camera, 110.0)))
    near = errors_px(camera, detector.detect(image, expected(camera, 8.0, (0.5, 0.5, 0))))
    assert set(far) == set(near) == set(BALLS)
    assert max(near.values()) < 0.06
    assert max(far.values()) < 0.06


def test_a_narrow_window_is_not_left(camera, detector):
    """What lies beyond the reach of a window is not the ball that is expected in it."""
    found = errors_px(camera, detector.detect(picture(camera), expected(camera, 20.0)))
    assert not [ball for ball, error in found.items() if error < 5]


def test_a_circle_beyond_a_wide_window_is_not_the_ball(camera, detector):
    elsewhere = [("red", (-70.0, 40.0, 420.0), 20.0)]
    image = picture(camera, ("green", "yellow"), elsewhere)
    assert "red" not in errors_px(camera, detector.detect(image, expected(camera, 110.0)))


def test_nor_is_one_of_another_size(camera, detector):
    image = picture(camera, ("green", "yellow"), [("red", BALLS["red"], 9.0)])
    assert "red" not in errors_px(camera, detector.detect(image, expected(camera, 110.0)))


def test_of_two_circles_the_nearer_is_likelier(camera, detector):
    further = [("red", BALLS["red"] + [-30.0, -42.0, 0.0], 20.0)]
    found = detector.detect(picture(camera, also=further), expected(camera, 130.0))
    assert errors_px(camera, found)["red"] < 0.06


def test_balls_of_one_colour_share_no_circle(camera):
    lost = expected(camera, 110.0)[:2]
    at = [camera.project(BALLS[e.ball][None])[0] for e in lost]
    circles = np.array([[*at[1], 46.0, 0.9, 0.9], [*at[0], 48.0, 0.8, 0.9]])
    moved = moved_to_circles(lost, dict.fromkeys(BALLS, circles), camera)
    assert [e.ball for e in moved] == ["green", "yellow"]
    assert np.allclose([e.center_px for e in moved], at)
    assert all(np.allclose(camera.project(e.center_camera[None])[0], e.center_px) for e in moved)


def test_only_balls_that_are_not_surely_found_are_lost(camera, detector):
    wide, narrow = expected(camera, 110.0, (0.5, 0, 0)), expected(camera, 20.0)
    found = detector.detect(picture(camera), expected(camera, 8.0, (0.5, 0, 0)))
    assert lost_in_wide_windows(wide, found) == ()
    assert [e.ball for e in lost_in_wide_windows(wide, found[1:])] == [found[0].ball]
    doubtful = [replace(found[0], score=0.5), *found[1:]]
    assert [e.ball for e in lost_in_wide_windows(wide, doubtful)] == [found[0].ball]
    assert lost_in_wide_windows(narrow, []) == ()
