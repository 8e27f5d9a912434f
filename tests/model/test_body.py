"""Bodies: what a pose can be told from, and what not."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import DegenerateGeometryError
from measure.model import Ball, BallColor, Body

GREEN = BallColor.named("green")


def body_of(*centers) -> Body:
    return Body("b", tuple(Ball(f"b{i}", GREEN, np.array(c), 20.0) for i, c in enumerate(centers)))


def test_the_papers_body_has_the_papers_distances(paper_body):
    side = pytest.approx(38 * 2**0.5)
    assert paper_body.distances() == {
        ("green", "yellow"): side, ("green", "red"): 76.0, ("yellow", "red"): side
    }  # fmt: skip
    assert paper_body.index("red") == 2
    np.testing.assert_array_equal(paper_body.radii, [20, 20, 20])
    assert paper_body.centers.shape == (3, 3)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_three_balls_are_needed(count):
    with pytest.raises(DegenerateGeometryError, match=f"has {count} balls"):
        body_of(*np.eye(3)[:count] * 40)


def test_balls_on_one_line_are_refused_with_their_extents():
    with pytest.raises(DegenerateGeometryError, match=r"extents 56\.\d and 0\.\d+ mm"):
        body_of([0, 0, 0], [40, 0.1, 0], [80, 0, 0])


def test_a_flat_triangle_that_can_be_told_is_accepted():
    assert body_of([0, 0, 0], [40, 4, 0], [80, 0, 0]).names == ("b0", "b1", "b2")


def test_two_balls_of_one_name_are_refused():
    balls = tuple(Ball("same", GREEN, c, 20.0) for c in np.eye(3) * 40)
    with pytest.raises(ValueError, match="'same'"):
        Body("b", balls)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_must_be_positive(radius):
    with pytest.raises(ValueError, match="ball x: radius_mm must be positive"):
        Ball("x", GREEN, np.zeros(3), radius)


def test_a_centre_must_be_three_finite_numbers():
    with pytest.raises(ValueError, match=r"ball x: center_mm: expected shape \(3\), got \(2,\)"):
        Ball("x", GREEN, np.zeros(2), 20.0)
    with pytest.raises(ValueError, match="ball x: center_mm must be finite"):
        Ball("x", GREEN, np.array([0, np.nan, 0]), 20.0)
