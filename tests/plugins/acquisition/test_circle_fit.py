"""Circles fitted to a colour's edge, against drawn discs."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._acquisition.circles import refined
from measure_plugins._acquisition.patches import framed


def disc(x, y, radius, shape=(90, 160)):
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (np.hypot(u - x, v - y) < radius).astype(np.uint8)


@pytest.mark.parametrize(("x", "y", "radius"), [(60.3, 40.7, 20.2), (100.0, 50.5, 8.4)])
@pytest.mark.parametrize("off", [(1.5, -1.0, 0.5), (-1.0, 1.0, -1.5)])
def test_a_circle_that_is_a_little_off_is_led_to_the_edge(x, y, radius, off):
    mask = framed(disc(x, y, radius), 1)
    found = refined(mask, np.array([x + off[0], y + off[1], radius + off[2], 0.5]))
    assert found[:3] == pytest.approx((x, y, radius), abs=0.3)
    assert found[3] == 1.0


def test_only_what_the_picture_shows_of_an_edge_counts():
    """The picture's own border is no edge; the rest of the circle is found by what is in sight."""
    mask = framed(disc(2.0, 45.0, 25.0), 1)
    found = refined(mask, np.array([3.0, 45.5, 24.0, 0.4]))
    assert found[:3] == pytest.approx((2.0, 45.0, 25.0), abs=0.6)
    assert 0.4 < found[3] < 0.6


def test_where_no_edge_is_near_the_circle_stays_what_it_was():
    mask = framed(disc(60.0, 40.0, 30.0), 1)
    circle = np.array([60.0, 40.0, 15.0, 0.3])
    assert np.array_equal(refined(mask, circle), circle)
