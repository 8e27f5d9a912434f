"""Balls that are small in a large picture, and what must not pass for one."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest

from benchmarks.photographs import outline
from measure.geometry import RigidTransform
from measure.model import Camera, Image, Intrinsics
from measure_plugins._acquisition import find_circles
from tests.plugins.acquisition.test_candidates import BGR
from tests.scenes import RAVEN

COLORS = [ball.color for ball in RAVEN.balls]
SIZES = [(640, 480), (1280, 720), (1920, 1080), (4000, 3000)]


def picture(size_wh, discs, noise=3.0, seed=0):
    """A picture of flat discs (colour, x, y, radius) on dark ground."""
    width, height = size_wh
    pixels = np.full((height, width, 3), 28, np.uint8)
    for color, x, y, radius in discs:
        center = round(x * 16), round(y * 16)
        cv2.circle(pixels, center, round(radius * 16), BGR[color], -1, cv2.LINE_AA, 4)
    grain = noise * np.random.default_rng(seed).standard_normal((height, width), np.float32)
    return cv2.add(pixels, cv2.cvtColor(grain, cv2.COLOR_GRAY2BGR), dtype=cv2.CV_8U)


def camera_of_size(width, height):
    lens = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
    return Camera("camera", Intrinsics((width, height), lens), RigidTransform.identity())


def found_in(pixels):
    return dict(zip(RAVEN.names, find_circles(pixels, COLORS).of_color, strict=True))


def nearest(circles, x, y):
    return min(circles, key=lambda c: np.hypot(c[0] - x, c[1] - y), default=np.full(6, np.nan))


@pytest.mark.parametrize("size_wh", SIZES, ids=str)
@pytest.mark.parametrize("radius", [7.0, 9.0, 13.0, 20.0, 31.0, 45.0])
def test_a_ball_of_any_size_is_found_in_a_picture_of_any_size(size_wh, radius):
    """Wherever it lies on the lattice that is looked at: 24 places for each."""
    rng, (width, height) = np.random.default_rng(int(radius)), size_wh
    places = np.stack(np.meshgrid(np.linspace(60, width - 60, 6), np.linspace(60, height - 60, 4)))
    places = places.reshape(2, -1).T + rng.uniform(-6, 6, (24, 2))
    for k, colors in enumerate(np.array_split(places, 2)):
        discs = [(RAVEN.names[(k + i) % 3], *at, radius) for i, at in enumerate(colors)]
        found = found_in(picture(size_wh, discs, seed=k))
        for name, x, y, _ in discs:
            circle = nearest(found[name], x, y)
            assert np.hypot(circle[0] - x, circle[1] - y) < max(1.6, 0.07 * radius)
            assert circle[2] == pytest.approx(radius, rel=0.08, abs=2.6)


def test_half_of_a_small_ball_is_enough():
    discs = [("red", 2011, 1507, 24), ("yellow", 3000, 700, 30), ("green", 3994, 2200, 28)]
    pixels = picture((4000, 3000), discs)
    pixels[1507:1540, 1980:2040] = 28  # the red one's lower half is hidden
    pixels[660:740, 2960:3000] = (90, 120, 150)  # the yellow one's left half, by a finger
    found = found_in(pixels)
    for name, x, y, radius in discs:  # the green one is cut by the frame
        circle = nearest(found[name], x, y)
        assert np.hypot(circle[0] - x, circle[1] - y) < 0.2 * radius


def test_large_and_small_balls_of_one_colour_are_found_together():
    discs = [("red", 1000, 1500, 400), ("red", 2500, 800, 60), ("red", 3100, 2300, 9)]
    red = found_in(picture((4000, 3000), discs))["red"]
    for _, x, y, radius in discs:
        circle = nearest(red, x, y)
        assert np.hypot(circle[0] - x, circle[1] - y) < max(1.5, 0.03 * radius)


@pytest.mark.parametrize("size_wh", SIZES, ids=str)
def test_noise_bars_and_letters_are_no_small_balls(size_wh):
    """Dots of single pixels, thin bars, and print, all in the colour of a ball."""
    width, height = size_wh
    pixels, rng = picture(size_wh, [], noise=6.0), np.random.default_rng(3)
    for x, y in rng.integers(0, [width - 2, height - 2], (width // 4, 2)):
        pixels[y : y + 2, x : x + 2] = BGR["red"]
    for k, (x, y) in enumerate(rng.integers(40, [width - 200, height - 60], (12, 2)).tolist()):
        cv2.rectangle(pixels, (x, y), (x + 90, y + 6 + k % 3), BGR["green"], -1)
    cv2.putText(pixels, "MEASURE", (60, height // 2), 0, 1.2, BGR["yellow"], 3)
    camera = camera_of_size(width, height)
    image = Image("camera", 0, 0.0, partial(np.asarray, pixels))
    believed = [d for d in outline(RAVEN, camera).detect(image, ()) if d.score > 0.8]
    assert not believed
