"""The transform between two sets of points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import transforms

from measure.errors import DegenerateGeometryError
from measure.geometry import align_points

TRIANGLE = np.array([[38.0, 0, 0], [0, 38, 0], [-38, 0, 0]])


@given(transforms())
def test_three_exact_points_give_the_transform_back(target_from_source):
    found = align_points(target_from_source.apply(TRIANGLE), TRIANGLE)
    np.testing.assert_allclose(found.difference(target_from_source), 0, atol=1e-9)


def test_the_answer_is_the_weighted_optimum(rng):
    source = rng.normal(scale=30, size=(6, 3))
    target = rng.normal(scale=2, size=(6, 3)) + source[:, [1, 2, 0]]
    weights = rng.uniform(0.1, 5, 6)

    def cost(transform):
        return weights @ np.sum((target - transform.apply(source)) ** 2, axis=1)

    best = align_points(target, source, weights)
    for axis in np.eye(6) * ([1e-2] * 3 + [1e-4] * 3):
        assert cost(best) < cost(best.perturb(axis))
        assert cost(best) < cost(best.perturb(-axis))


def test_a_mirrored_body_is_never_fitted_by_a_reflection(rng):
    source = rng.normal(scale=30, size=(5, 3))
    mirrored = source * [1, 1, -1]
    found = align_points(mirrored, source)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.linalg.norm(mirrored - found.apply(source), axis=1).max() > 5


def test_a_point_of_weight_zero_does_not_count(rng):
    wrong = TRIANGLE + 0
    wrong = np.vstack([wrong, [500.0, 500, 500]])
    source = np.vstack([TRIANGLE, [0.0, 0, 10]])
    found = align_points(wrong, source, [1, 1, 1, 0])
    np.testing.assert_allclose(found.matrix, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_are_refused(count):
    with pytest.raises(DegenerateGeometryError, match=f"got {count} of {count}"):
        align_points(TRIANGLE[:count].reshape(-1, 3), TRIANGLE[:count].reshape(-1, 3))


def test_points_on_one_line_are_refused_with_their_extents():
    line = np.outer([1.0, 2, 4, 8], [3, 2, 1])
    with pytest.raises(DegenerateGeometryError, match=r"4 points on one line .* leave a turn"):
        align_points(line, line)


def test_points_that_are_not_finite_are_refused():
    target = TRIANGLE.copy()
    target[1, 1] = np.nan
    with pytest.raises(DegenerateGeometryError, match="got 2 of 3"):
        align_points(target, TRIANGLE)


def test_different_numbers_of_points_are_refused():
    with pytest.raises(ValueError, match=r"source: expected shape \(3, 3\), got \(2, 3\)"):
        align_points(TRIANGLE, TRIANGLE[:2])
