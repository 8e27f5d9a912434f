from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.errors import SessionError
from measure.model import Ball, BallColor, Body, ColorRange
from measure.session import read_body, write_body
from tests.session.conftest import BODY

GREEN = [[40, 150, 30], [60, 200, 50], [30, 120, 25], [50, 180, 40]]
USUAL = [[45, 165, 36]]


def _body(tmp_path: Path, color: str) -> Body:
    (tmp_path / "body.toml").write_text(BODY.replace('color = "green"', f"color = {color}"))
    return read_body(tmp_path / "body.toml")


def test_a_body_of_named_colours(tmp_path: Path) -> None:
    body = _body(tmp_path, '"Green"')
    assert body.name == "triangle"
    assert body.names == ("green", "yellow", "red")
    assert body.centers.tolist() == [[38, 0, 0], [0, 38, 0], [-38, 0, 0]]
    assert body.radii.tolist() == [20, 20, 20]
    assert body.balls[0].color == BallColor.named("green")


@pytest.mark.parametrize(
    "color",
    [
        f"{{samples_bgr = {GREEN}}}",
        "{hsv = {low = [40, 60, 30], high = [80, 255, 255]}}",
        "{hsv = [{low = [40,60,30], high = [60,255,255]}, {low = [61,60,9], high = [80,255,255]}]}",
        "{lab = {low = [20, 0, 130], high = [255, 110, 220]}}",
    ],
)
def test_colours_learnt_and_given(tmp_path: Path, color: str) -> None:
    found = _body(tmp_path, color).balls[0].color
    assert found.matches(USUAL).all()
    assert not found.matches([[200, 40, 30], [30, 30, 200], [128, 128, 128]]).any()


def test_samples_from_a_picture(tmp_path: Path) -> None:
    picture = np.full((60, 80, 3), 128, np.uint8)
    picture[10:40, 20:60] = [40, 160, 30]
    cv2.imwrite(str(tmp_path / "ball.png"), picture)
    found = _body(tmp_path, '{samples = {image = "ball.png", crop_xywh = [25, 15, 30, 20]}}')
    assert found.balls[0].color.matches(USUAL).all()
    assert not found.balls[0].color.matches([[128, 128, 128]]).any()
    with pytest.raises(SessionError, match=r"ball\.png: the crop .* leaves the picture of 80x60"):
        _body(tmp_path, '{samples = {image = "ball.png", crop_xywh = [60, 15, 30, 20]}}')
    with pytest.raises(SessionError, match=r"did you mean ball\.png"):
        _body(tmp_path, '{samples = {image = "bal.png", crop_xywh = [25, 15, 30, 20]}}')


@pytest.mark.parametrize(
    ("color", "words"),
    [
        ("{}", "give one of samples_bgr, samples, hsv or lab, not none"),
        ("{hsv = {low = [0,0,0], high = [9,9,9]}, samples_bgr = [[1,2,3]]}", "not samples_bgr and"),
        ("{samples_bgr = [[1, 2, 3]]}", "at least 3 samples"),
        ("{hsv = {low = [0, 0, 0], high = [300, 9, 9]}}", "less than or equal to 255"),
        ("{hsv = []}", "'balls[0].color': holds no range: give {hsv = "),
        (
            "{hsv = {low = [168, 200, 0], high = [8, 90, 255]}}",
            "hsv: no colour lies between low [168, 200, 0] and high [8, 90, 255]",
        ),
        ("{lab = [{low = [9, 0, 0], high = [8, 9, 9]}]}", "lab: no colour lies between low [9, 0"),
        (
            "{hsv = {low = [200, 0, 0], high = [255, 9, 9]}}",
            "hsv: hues run from 0 to 179, low is [",
        ),
        ("{hvs = 3}", "unknown key"),
        ("3", "color"),
    ],
)
def test_a_bad_colour_is_explained(tmp_path: Path, color: str, words: str) -> None:
    with pytest.raises(SessionError, match=r"body\.toml:5") as caught:
        _body(tmp_path, color)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_body_survives_writing_and_reading(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colors = [
        BallColor.named("red"),
        BallColor.from_samples(GREEN),
        BallColor("range", (ColorRange("lab", (1, 2, 3), (4, 5, 6)),)),
        BallColor("range", (ColorRange("hsv", (170, 2, 3), (9, 5, 6)),) * 2),
    ]
    balls = tuple(
        Ball(f'ball "{i}"', color, rng.normal(0, 40, 3), 10 + rng.random())
        for i, color in enumerate(colors)
    )
    write_body(tmp_path / "b.toml", Body("my = body", balls))
    back = read_body(tmp_path / "b.toml")
    assert back.name == "my = body"
    assert back.names == tuple(ball.name for ball in balls)
    assert np.array_equal(back.centers, np.stack([ball.center_mm for ball in balls]))
    assert np.array_equal(back.radii, [ball.radius_mm for ball in balls])
    assert [ball.color.ranges for ball in back.balls] == [color.ranges for color in colors]
