"""What effects a view's outlines alike, eliminated as if it stood in one large system."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from measure_plugins._joint_fit.elimination import (
    back_substitute,
    eliminate,
    eliminate_view_shifts,
    empty_equations,
    prior_view_shifts,
    subtract_view_shifts,
    update_view_shifts,
)
from measure_plugins._joint_fit.solve import by_effect

VIEW_OF = np.array([0, 0, 0, 1, 1])
VARIANCES = np.array([[0.01, 0.02, 0.03], [0.04, 0.01, 0.02], [0.3, 0.3, 0.1]] + [[0.02] * 3] * 2)
UNCERTAIN = np.array([[[0.5, 0.2], [0.2, 0.3]], np.zeros((2, 2))])
SHARED, OFFSETS = 6, 2
"""Unknowns of the pose, and of the views' edges."""


def moments(rng):
    """Of five ball-views with forty points each: pose, offset, x, y, residual."""
    out = []
    for _ in VIEW_OF:
        rows = rng.normal(size=(40, 10))
        rows[:, 6] = 1.0
        out.append(rows.T @ rows)
    return np.array(out)


def dense(sums, uncertain):
    """Normal matrix and right side of all unknowns: pose, offsets, views' effects, own effects."""
    first = SHARED + OFFSETS
    n = first + 2 * OFFSETS + 3 * len(VIEW_OF)
    normal, right = np.zeros((n, n)), np.zeros(n)
    for k, view in enumerate(VIEW_OF):
        own = first + 2 * OFFSETS + 3 * k
        shifts = first + 2 * view
        # Columns 7, 8 and 6 are x, y and radius; x and y belong to the view's shift as well.
        columns = [*range(6), 6, 7, 8, 7, 8, 6]
        at = [*range(6), SHARED + view, shifts, shifts + 1, own, own + 1, own + 2]
        normal[np.ix_(at, at)] += sums[k][np.ix_(columns, columns)]
        right[at] += sums[k][columns, 9]
        normal[range(own, own + 3), range(own, own + 3)] += 1 / VARIANCES[k]
    for view in range(OFFSETS):
        at = slice(first + 2 * view, first + 2 * view + 2)
        certain = 1e12 * np.eye(2)
        normal[at, at] += np.linalg.inv(uncertain[view]) if uncertain[view].any() else certain
    return normal, right


def reduced(equations):
    normal, right = np.zeros((SHARED + OFFSETS,) * 2), np.zeros(SHARED + OFFSETS)
    for k, view in enumerate(VIEW_OF):
        at = [*range(SHARED), SHARED + view]
        normal[np.ix_(at, at)] += equations.normal[k]
        right[at] += equations.right[k]
    return normal, right


@pytest.fixture
def solved():
    """What was eliminated, and the same system solved as a whole."""
    sums = moments(np.random.default_rng(4))
    equations, shifts = empty_equations(len(VIEW_OF)), prior_view_shifts(UNCERTAIN)
    eliminate(sums, VARIANCES, equations)
    eliminate_view_shifts(VIEW_OF, VARIANCES, equations, shifts)
    normal, right = dense(sums, UNCERTAIN)
    return equations, shifts, np.linalg.inv(normal), np.linalg.solve(normal, right)


def test_steps_and_their_covariance_are_those_of_the_whole_system(solved):
    equations, _, inverse, whole = solved
    normal, right = reduced(equations)
    np.testing.assert_allclose(normal, normal.T, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(normal, right), whole[: len(right)], rtol=1e-6)
    known = inverse[: len(right), : len(right)]
    np.testing.assert_allclose(np.linalg.inv(normal), known, rtol=1e-5, atol=1e-9)


def test_shifts_are_those_of_the_whole_system(solved):
    equations, shifts, _, whole = solved
    own, first = np.empty((len(VIEW_OF), 3)), SHARED + OFFSETS
    back_substitute(VIEW_OF, equations, whole[:first], own)
    update_view_shifts(whole[:first], shifts)
    np.testing.assert_allclose(shifts.shift[0], whole[first : first + 2], rtol=1e-6)
    np.testing.assert_allclose(own.ravel(), whole[first + 2 * OFFSETS :], rtol=1e-5, atol=1e-9)


def test_own_unknowns_are_as_uncertain_as_in_the_whole_system_given_what_is_shared(solved):
    equations = solved[0]
    normal, _ = dense(moments(np.random.default_rng(4)), UNCERTAIN)
    given = np.linalg.inv(normal[SHARED + OFFSETS :, SHARED + OFFSETS :])[2 * OFFSETS :]
    for k in range(len(VIEW_OF)):
        at = slice(3 * k, 3 * k + 3)
        own = given[at, 2 * OFFSETS :][:, at]
        np.testing.assert_allclose(equations.effect_covariance[k], own, rtol=1e-6, atol=1e-12)


def test_what_cameras_may_add_to_the_covariance_is_taken_back(solved):
    """Their variance times how the whole system's solution follows a view's outlines."""
    equations, shifts, inverse, _ = solved
    sums, right = moments(np.random.default_rng(4)), np.zeros((len(inverse), 2))
    for k in np.flatnonzero(VIEW_OF == 0):
        own = SHARED + OFFSETS + 2 * OFFSETS + 3 * k
        at = [*range(6), SHARED, SHARED + OFFSETS, SHARED + OFFSETS + 1, own, own + 1, own + 2]
        right[at] += sums[k][[*range(6), 6, 7, 8, 7, 8, 6], 7:9]
    lever = (inverse @ right)[:6]
    outlines = SimpleNamespace(view_of=VIEW_OF)
    reactions = by_effect.py_func(
        outlines, equations, VARIANCES, np.linalg.inv(reduced(equations)[0])
    )
    covariance = inverse[:6, :6].copy()
    subtract_view_shifts(VIEW_OF, shifts, reactions, covariance)
    added = inverse[:6, :6] - covariance
    np.testing.assert_allclose(added, lever @ UNCERTAIN[0] @ lever.T, atol=1e-4 * np.max(added))
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_exact_cameras_change_nothing():
    sums = moments(np.random.default_rng(4))
    equations, same = empty_equations(len(VIEW_OF)), empty_equations(len(VIEW_OF))
    for each in (equations, same):
        eliminate(sums, VARIANCES, each)
    eliminate_view_shifts(VIEW_OF, VARIANCES, equations, prior_view_shifts(np.zeros((2, 2, 2))))
    for changed, left in zip(equations, same, strict=True):
        np.testing.assert_array_equal(changed, left)


@pytest.mark.parametrize(("shift", "inverse_weight"), [(1.0, 1.0), (3.0, 1.0), (6.0, 36 / 9.2)])
def test_a_camera_is_doubted_once_it_is_off_by_more_than_three_standard_deviations(
    shift, inverse_weight
):
    shifts = prior_view_shifts(np.array([0.25 * np.eye(2)]))
    shifts.offset[0, 0] = 0.5 * shift
    update_view_shifts(np.zeros(7), shifts)
    assert shifts.inverse_weight[0] == pytest.approx(inverse_weight)
