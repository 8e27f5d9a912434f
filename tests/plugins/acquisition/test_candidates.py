from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.model import BallColor, Image
from measure_plugins._acquisition import find_circles
from tests.scenes import FOUR, RAVEN

BGR = {
    "green": (60, 140, 40),
    "yellow": (30, 190, 210),
    "red": (35, 30, 180),
    "white": (225, 230, 228),
    "blue": (170, 80, 30),
    "orange": (20, 110, 235),
}


def picture(discs, background=(28, 28, 28), noise=3.0, seed=0, gain=1.0):
    """An image of flat discs (colour, x, y, radius), the later ones in front."""
    pixels = np.full((720, 1280, 3), background, np.uint8)
    for color, x, y, radius in discs:
        bgr = BGR.get(color, color)
        cv2.circle(
            pixels, (round(x * 16), round(y * 16)), round(radius * 16), bgr, -1, cv2.LINE_AA, 4
        )
    noisy = pixels * gain + np.random.default_rng(seed).normal(scale=noise, size=pixels.shape)
    return Image("cam0", 0, 0.5, lambda: np.clip(noisy, 0, 255).astype(np.uint8))


def search(image, body=RAVEN):
    """Circles (k, 6) of each ball's colour, see `FoundCircles`."""
    colors = [ball.color for ball in body.balls]
    found = find_circles(image.pixels, colors).of_color
    return dict(zip(body.names, found, strict=True))


def assert_at(circle, x, y, radius, within):
    assert np.linalg.norm(circle[:2] - [x, y]) < within
    assert circle[2] == pytest.approx(radius, rel=0.08, abs=2)


@pytest.mark.parametrize("radius", [14.0, 45.0, 120.0])
@pytest.mark.parametrize("gain", [0.35, 1.0], ids=["dim", "bright"])
def test_finds_each_ball_first(radius, gain):
    at = {"green": (300.3, 350.6), "yellow": (640.2, 300.9), "red": (980.7, 420.1)}
    image = picture([(c, x, y, radius) for c, (x, y) in at.items()], gain=gain)
    for name, candidates in search(image).items():
        assert_at(candidates[0], *at[name], radius, 1.5)


def test_hidden_behind_another_ball():
    found = search(picture([("green", 600, 300, 60), ("yellow", 650, 330, 60)]))
    assert_at(found["yellow"][0], 650, 330, 60, 1.5)
    assert_at(found["green"][0], 600, 300, 60, 4.0)
    assert found["green"][0, 3] < 0.8 < found["yellow"][0, 3]  # the shares that are seen


def test_two_touching_balls_of_one_colour_are_two_candidates():
    found = search(picture([("red", 600, 300, 50), ("red", 670, 330, 45)]))["red"]
    assert len(found) >= 2
    assert_at(found[0], 600, 300, 50, 3.0)
    assert_at(found[1], 670, 330, 45, 3.0)


def test_four_balls_white_among_them():
    at = {"white": (300, 300), "blue": (500, 420), "orange": (700, 250), "green": (900, 400)}
    image = picture([(c, x, y, 40) for c, (x, y) in at.items()])
    for name, candidates in search(image, FOUR).items():
        assert_at(candidates[0], *at[name], 40, 1.5)


def test_a_highlight_and_a_rod_in_front_do_not_split_a_ball():
    rod = [((40, 40, 42), 500 + 3 * i, 200 + 8 * i, 5) for i in range(40)]
    found = search(picture([("green", 570, 360, 60), ((250, 250, 250), 555, 340, 9), *rod]))
    assert_at(found["green"][0], 570, 360, 60, 3.0)


def test_an_orange_ball_in_front_of_cardboard_of_its_hue_is_found():
    """Both are within the named range; the ball is more vivid."""
    cardboard, orange = (40, 60, 90), BallColor.named("orange")
    image = picture([((30, 70, 235), 600, 300, 40)], background=cardboard)
    assert orange.matches([cardboard, (30, 70, 235)]).all()
    found = find_circles(image.pixels, [orange])
    (circle, *_) = found.of_color[0]
    assert_at(circle, 600, 300, 40, 1.5)
    assert int(circle[5]) == 1  # by the bit of vivid pixels
    alone = picture([((30, 70, 235), 600, 300, 40)])
    assert find_circles(alone.pixels, [orange]).of_color[0][0, 5] == 0


def test_no_ball_no_candidate():
    assert all(len(circles) == 0 for circles in search(picture([])).values())
    assert len(search(picture([("blue", 500, 300, 50)]))["red"]) == 0


def test_a_box_is_a_worse_candidate_than_a_ball():
    image = picture([("red", 300, 400, 35)])
    pixels = image.pixels.copy()
    pixels[200:400, 700:850] = BGR["red"]
    found = search(Image("cam0", 0, 0.0, lambda: pixels))["red"]
    assert_at(found[0], 300, 400, 35, 1.5)


def test_other_image_sizes():
    image = picture([("green", 320, 180, 60)])
    small = cv2.resize(image.pixels, (640, 360), interpolation=cv2.INTER_AREA)
    found = search(Image("cam0", 0, 0.0, lambda: small))
    assert_at(found["green"][0], 160 - 0.25, 90 - 0.25, 30, 1.0)


@pytest.mark.parametrize("most", [3, 10])
def test_no_more_candidates_than_asked_for(monkeypatch, most):
    """However many balls there are: every candidate has to be looked at. The largest are kept."""
    radii = np.linspace(15, 50, 24)
    places = [(110 + 150 * (k % 8), 110 + 200 * (k // 8)) for k in range(24)]
    discs = [("red", x, y, r) for (x, y), r in zip(places, radii, strict=True)]
    monkeypatch.setattr("measure_plugins._acquisition.candidates._MAX_CANDIDATES", most)
    found = search(picture(discs))["red"]
    assert len(found) == most
    assert found[:, 2] == pytest.approx(radii[::-1][:most], abs=2)


def shaded(pixels, color, x, y, radius, light=(0.5, -0.6, 0.6)):
    """Draw a ball that is lit from one side: its other side is as dark as it is in a room."""
    v, u = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    across = np.stack([u - x, v - y], axis=-1) / radius
    inside = np.sum(across**2, axis=-1) < 1
    depth = np.sqrt(np.maximum(1 - np.sum(across**2, axis=-1), 0))
    toward = np.concatenate([across, depth[..., None]], axis=-1) @ light
    shade = 0.3 + 0.7 * np.clip(toward, 0, 1)
    pixels[inside] = np.clip(shade[..., None] * np.array(BGR[color]), 0, 255)[inside]


@pytest.mark.parametrize("ground", [30, 50, 120, 150])
def test_a_white_ball_is_found_where_its_shaded_side_is_not_white(ground):
    """On dark ground its shade is too dark for white; on light ground the ground is white too."""
    lit = (0.5, -0.6, 0.6) if ground < 100 else (0.0, 0.0, 1.0)
    ambient = np.full((720, 1280, 3), ground, np.uint8)
    shaded(ambient, "white", 500, 300, 50, lit)
    if ground >= 100:  # light all round: no side falls off to the ground's own grey
        cv2.circle(ambient, (500, 300), 50, (235, 240, 238), -1)
    noise = np.random.default_rng(1).normal(scale=2.0, size=ambient.shape)
    image = Image("cam0", 0, 0.0, lambda: np.clip(ambient + noise, 0, 255).astype(np.uint8))
    found = search(image, FOUR)
    assert_at(found["white"][0], 500, 300, 50, 4.0)
    assert all(len(found[name]) == 0 for name in FOUR.names if name != "white")
