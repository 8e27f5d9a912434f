"""Colours of an object of one's own: clicked, named, left out, and kept."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.errors import ConfigError, SessionError
from measure_studio.api import BallColors

BALLS = {
    "blue": ((80, 90), (150, 60, 20)),
    "orange": ((200, 90), (20, 110, 210)),
    "white": ((320, 90), (215, 215, 215)),
    "pink": ((440, 90), (150, 80, 225)),
}
"""Centre in px and colour, BGR."""


def picture():
    """Shaded balls before black cloth, and a grey table below."""
    pixels = np.full((240, 640, 3), 18, np.uint8)
    pixels[180:] = 90
    for (u, v), bgr in BALLS.values():
        for radius in range(30, 0, -1):
            shade = 1 - 0.4 * radius / 30
            cv2.circle(pixels, (u, v), radius, tuple(shade * c for c in bgr), -1)
    return pixels


def test_a_click_learns_any_colour_and_it_is_kept(tmp_path):
    file = tmp_path / "colours.toml"
    colors = BallColors(file)
    for name in ("blue", "orange", "white", "pink"):
        assert colors.learn(picture(), BALLS[name][0]) == name
        red, green, blue = colors.rgb(name)
        assert np.abs(np.subtract((blue, green, red), BALLS[name][1])).max() < 100
    assert colors.learn(picture(), (BALLS["blue"][0][0] + 5, 92)) == "blue"
    assert len(colors.learnt["blue"]) == 2
    again = BallColors(file)
    assert again.colors.keys() == colors.colors.keys()
    assert np.array_equal(again.learnt["blue"][0], np.concatenate(colors.learnt["blue"]))
    bodies = again.bodies(15.0)
    assert all((body.radii == 15.0).all() for body in bodies)
    found = {ball.name: ball.color for body in bodies for ball in body.balls}
    assert all(found[name] == color for name, color in again.colors.items())


@pytest.mark.parametrize("at", [(20, 20), (300, 220)], ids=["cloth", "table"])
def test_what_is_no_ball_teaches_nothing(tmp_path, at):
    colors = BallColors(tmp_path / "colours.toml")
    with pytest.raises(ConfigError, match="here: click a ball"):
        colors.learn(picture(), at)
    assert not colors.learnt
    assert not colors.file.exists()


def test_balls_are_left_out_added_and_called(tmp_path):
    def searched():
        return {ball.name for body in colors.bodies(15.0) for ball in body.balls}

    colors = BallColors(tmp_path / "colours.toml")
    every = searched()
    colors.learn(picture(), BALLS["blue"][0])
    assert searched() == every
    colors.leave_out("blue")  # what was learnt is forgotten; the common blue is there again
    assert searched() == every
    assert not colors.file.exists()
    colors.leave_out("blue")
    assert searched() == every - {"blue"}
    colors.add("blue")
    colors.call("blue", "tip")
    assert searched() == (every - {"blue"}) | {"tip"}
    with pytest.raises(ConfigError, match="another ball is called tip"):
        colors.call("red", "tip")
    for name in every - {"red", "green"}:
        colors.leave_out(name)
    with pytest.raises(SessionError, match="needs 3 balls"):
        searched()
