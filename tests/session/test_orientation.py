"""Pictures as viewers show them, by the laws of turning."""

from __future__ import annotations

import numpy as np
import pytest

from measure.session import Orientation

TAGS = range(1, 9)


def marked(size_wh, at):
    pixels = np.zeros((size_wh[1], size_wh[0], 3), np.uint8)
    pixels[at[1], at[0]] = 255
    return pixels


@pytest.mark.parametrize("tag", TAGS)
def test_a_pixel_is_shown_where_its_coordinates_say(tag):
    turn = Orientation((7, 4), tag)
    shown = turn.shown(marked((7, 4), (5, 1)))
    (row, column), *others = np.argwhere(shown[:, :, 0]).tolist()
    assert not others
    assert np.array_equal(turn.points_shown(np.array([[5.0, 1.0]]))[0], [column, row])
    assert turn.turns == (tag != 1)


@pytest.mark.parametrize("tag", TAGS)
def test_there_and_back(tag):
    turn, points = Orientation((1280, 720), tag), np.random.default_rng(tag).uniform(0, 700, (9, 2))
    assert np.allclose(turn.points_stored(turn.points_shown(points)), points)
    assert np.allclose(turn.matrix @ turn.matrix.T, np.eye(2))


@pytest.mark.parametrize("tag", [0, 9, -1, 300])
def test_other_tags_turn_nothing(tag):
    assert not Orientation((7, 4), tag).turns


def test_the_usual_upright_phone():
    """Tag 6: what is stored at the left is shown on top."""
    shown = Orientation((4, 3), 6).points_shown(np.array([[0.0, 0.0], [3.0, 0.0]]))
    assert shown.tolist() == [[2.0, 0.0], [2.0, 3.0]]
