"""Real photographs: spheres on a surgical robot, and perforated balls in a workshop."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.model import Ball, BallColor, Body, Camera, Expectation, Image, Intrinsics
from measure_paper.hough import HoughDetector, HoughSettings

OTHERS = (
    Ball("other 1", BallColor.named("blue"), np.array([0.0, 50.0, 0.0]), 20.0),
    Ball("other 2", BallColor.named("orange"), np.array([0.0, -50.0, 20.0]), 20.0),
)


def read(path):
    pixels = cv2.imread(str(path))
    return Image("camera", 0, 0.0, lambda: pixels)


def detector(image, color, radius_px=None, **settings):
    """A detector of one ball, with a camera made up so that its radius range is `radius_px`."""
    height, width = image.pixels.shape[:2]
    matrix = np.array([[1000.0, 0, width / 2], [0, 1000.0, height / 2], [0, 0, 1]])
    camera = Camera("camera", Intrinsics((width, height), matrix), RigidTransform.identity())
    body = Body("photo", (Ball("ball", color, np.array([50.0, 0, 0]), 20.0), *OTHERS))
    if radius_px is not None:
        near, far = (1000.0 * 20.0 / r for r in reversed(radius_px))
        settings = {"nearest_mm": near, "farthest_mm": far, **settings}
    return HoughDetector(HoughSettings(**settings), body, camera)


def test_spheres_of_a_surgical_robot(shared):
    """Six outlines marked to about 0.3 px, each partly hidden; predicted 8 px beside the truth."""
    folder = shared / "data" / "dvrk_red_spheres"
    marks = json.loads((folder / "marks.json").read_text())
    errors = []
    for mark in marks.values():
        image = read(folder / mark["file"])
        radius, center = float(np.mean(mark["semi_axes"])), np.array(mark["center"])
        window = Expectation(
            "ball", center + np.array([6.0, -5.0]), (0.9 * radius, 1.1 * radius), radius, 15.0
        )
        found = detector(image, BallColor.named("red")).detect(image, [window])
        ball = next(d for d in found if d.ball == "ball")
        assert ball.score > 0.7
        assert abs(ball.radius_px - radius) < 2.5
        errors.append(np.linalg.norm(ball.center_px - center))
    assert max(errors) < 3.5
    assert np.sqrt(np.mean(np.square(errors))) < 2.2


@pytest.mark.parametrize(
    ("color", "hues", "samples", "balls"),
    [
        ("green", (60, 95), [(289, 369)], [(287, 370)]),
        ("purple", (125, 165), [(102, 364), (190, 369)], [(190, 369), (378, 368)]),
    ],
)
def test_perforated_balls_in_clutter(shared, color, hues, samples, balls):
    """Colours learnt from the picture itself; the balls' places were read off by eye."""
    image = read(shared / "data" / "ball_photos" / "IMG_3049.webp")
    height, width = image.pixels.shape[:2]
    y, x = np.mgrid[:height, :width]
    near = np.any([np.hypot(x - cx, y - cy) < 20 for cx, cy in samples], axis=0)
    hsv = cv2.cvtColor(image.pixels, cv2.COLOR_BGR2HSV)
    plastic = near & (hsv[..., 0] >= hues[0]) & (hsv[..., 0] <= hues[1]) & (hsv[..., 1] > 40)
    estimated_appearance = BallColor.from_samples(image.pixels[plastic])
    finder = detector(image, estimated_appearance, (14, 50), circles=5)
    found = [d for d in finder.detect(image, []) if d.ball == "ball"]
    assert found, color
    for place in balls:
        nearest = min(found, key=lambda d: np.linalg.norm(d.center_px - np.array(place)))
        assert np.linalg.norm(nearest.center_px - place) < 8.0
        assert 18 < nearest.radius_px < 32
