"""Rigid transforms by their laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import numeric_jacobian, rotvecs, small_steps, transforms, vectors

from measure.geometry import RigidTransform, skew


def assert_same(actual: RigidTransform, expected: RigidTransform, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(actual.rotation, expected.rotation, atol=atol, rtol=0)
    np.testing.assert_allclose(actual.translation, expected.translation, atol=1e3 * atol, rtol=0)


@given(transforms())
def test_rotations_are_proper(target_from_source):
    r = target_from_source.rotation
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r) == pytest.approx(1)


@given(transforms())
def test_the_inverse_undoes(a):
    assert_same(a @ a.inverse(), RigidTransform.identity())
    assert_same(a.inverse() @ a, RigidTransform.identity())
    assert_same(a.inverse().inverse(), a)


@given(transforms(), transforms(), transforms())
def test_composition_is_associative(a, b, c):
    assert_same((a @ b) @ c, a @ (b @ c))


@given(transforms(), transforms())
def test_the_inverse_of_a_composition_swaps(a, b):
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(transforms(), transforms(), vectors())
def test_composing_is_applying_one_after_the_other(a, b, point):
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)


@given(transforms(), vectors(), vectors())
def test_vectors_turn_as_differences_of_points(a, p, q):
    np.testing.assert_allclose(a.rotate(p - q), a.apply(p) - a.apply(q), atol=1e-9)


@given(transforms(), vectors())
def test_the_homogeneous_matrix_does_the_same(a, point):
    np.testing.assert_allclose((a.matrix @ [*point, 1])[:3], a.apply(point), atol=1e-9)
    assert_same(RigidTransform.from_matrix(a.matrix), a)


@given(rotvecs())
def test_the_logarithm_undoes_the_exponential(rotvec):
    turn = RigidTransform.from_rotvec(rotvec)
    assert np.linalg.norm(turn.rotvec) <= np.pi + 1e-12
    assert_same(RigidTransform.from_rotvec(turn.rotvec), turn)
    if np.linalg.norm(rotvec) < np.pi - 1e-6:  # at half a turn the axis may point either way
        np.testing.assert_allclose(turn.rotvec, rotvec, atol=1e-9)


@given(transforms())
def test_the_quaternion_says_the_same(a):
    assert a.quat_wxyz[0] >= 0
    assert np.linalg.norm(a.quat_wxyz) == pytest.approx(1)
    assert_same(RigidTransform.from_quat_wxyz(-3 * a.quat_wxyz, a.translation), a)


@given(transforms(), transforms())
def test_the_difference_is_the_step_between_two_poses(a, b):
    assert_same(a.perturb(b.difference(a)), b)


@given(transforms(), small_steps())
def test_a_small_step_is_recovered_exactly(a, step):
    np.testing.assert_allclose(a.perturb(step).difference(a), step, atol=1e-9)


@given(transforms(), small_steps())
def test_steps_are_taken_in_the_target_frame(a, step):
    """The translation moves along the target's axes; turning does not move the origin."""
    moved = a.perturb(step)
    np.testing.assert_allclose(moved.translation, a.translation + step[:3], atol=1e-12)
    np.testing.assert_allclose(
        moved.rotation, RigidTransform.from_rotvec(step[3:]).rotation @ a.rotation, atol=1e-12
    )


@given(transforms(), vectors(50))
def test_the_derivative_of_a_moved_point_by_the_step(a, point):
    numeric = numeric_jacobian(lambda d: a.perturb(d).apply(point), np.zeros(6), 1e-5)
    analytic = np.hstack([np.eye(3), -skew(a.rotate(point))])
    np.testing.assert_allclose(numeric, analytic, atol=1e-6)


@given(vectors(), vectors())
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-6)
    np.testing.assert_array_equal(skew(a), -skew(a).T)


def test_batches_act_row_by_row(rng):
    rotvecs, shifts, points = rng.normal(size=(3, 5, 3))
    many = RigidTransform.from_rotvec(rotvecs, shifts)
    other = RigidTransform.from_rotvec([0.1, 0.2, 0.3], [1, 2, 3])
    for i in range(5):
        one = RigidTransform.from_rotvec(rotvecs[i], shifts[i])
        np.testing.assert_allclose(many.apply(points)[i], one.apply(points[i]))
        np.testing.assert_allclose(many.matrix[i], one.matrix)
        assert_same(many[i], one)
        assert_same((many @ other)[i], one @ other)
        assert_same((other @ many)[i], other @ one)
        assert_same(many.inverse()[i], one.inverse())
        np.testing.assert_allclose(many.difference(other)[i], one.difference(other))


def test_batch_axes_are_broadcast():
    turns = RigidTransform.from_rotvec(np.zeros((4, 3)))
    assert turns.translation.shape == (4, 3)
    assert turns.matrix.shape == (4, 4, 4)
    shifts = RigidTransform(np.eye(3), np.zeros((4, 3)))
    assert shifts.rotation.shape == (4, 3, 3)
    assert shifts.difference(RigidTransform.identity()).shape == (4, 6)


@pytest.mark.parametrize(
    "upper_left",
    [np.diag([1, 1, -1.0]), 2 * np.eye(3), np.eye(3) + 1e-3, np.full((3, 3), np.nan)],
    ids=["mirror", "scale", "shear", "nan"],
)
def test_a_matrix_that_is_no_rotation_is_refused(upper_left):
    matrix = np.eye(4)
    matrix[:3, :3] = upper_left
    with pytest.raises(ValueError, match="not a rotation"):
        RigidTransform.from_matrix(matrix)


def test_a_quaternion_of_no_length_is_refused():
    with pytest.raises(ValueError, match="zero norm"):
        RigidTransform.from_quat_wxyz([0, 0, 0, 0], [0, 0, 0])


def test_wrong_shapes_are_refused_with_both_shapes():
    with pytest.raises(ValueError, match=r"rotation: expected shape \(\.\.\., 3, 3\), got \(3,\)"):
        RigidTransform(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match=r"points: expected shape \(\.\.\., 3\), got \(2,\)"):
        RigidTransform.identity().apply([1, 2])


def test_nothing_is_changed_in_place(rng):
    rotation, shift, delta = np.eye(3), np.zeros(3), rng.normal(size=6)
    copies = rotation.copy(), shift.copy(), delta.copy()
    a = RigidTransform(rotation, shift)
    (a.perturb(delta) @ a).inverse()
    for now, before in zip((rotation, shift, delta), copies, strict=True):
        np.testing.assert_array_equal(now, before)


@given(rotvecs())
def test_one_rotation_is_what_a_batch_of_it_is(rotvec):
    one, many = RigidTransform.from_rotvec(rotvec), RigidTransform.from_rotvec(np.stack([rotvec]))
    np.testing.assert_allclose(one.rotation, many.rotation[0], atol=1e-14)
    np.testing.assert_allclose(one.rotvec, many.rotvec[0], atol=1e-9)
