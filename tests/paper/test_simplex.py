from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, align_points, squared_mahalanobis
from measure.model import BallPosition
from measure_paper.midpoint import MidpointSettings, MidpointTriangulator
from measure_paper.simplex import SimplexSettings, SimplexSolver, initial_guess
from tests.scenes import FOUR, RAVEN, a_pose, of_ball, ring, see

CAMERAS = ring(4)


def fixes_of(body, pose, sd_mm=0.0, rng=None, names=None):
    noise = (
        np.zeros((len(body.balls), 3))
        if rng is None
        else rng.normal(0, sd_mm, (len(body.balls), 3))
    )
    centers = pose.apply(body.centers) + noise
    return [
        BallPosition(
            ball.name, 0.0, center, np.eye(3) * max(sd_mm, 0.1) ** 2, tuple(CAMERAS), np.zeros(4)
        )
        for ball, center in zip(body.balls, centers, strict=True)
        if names is None or ball.name in names
    ]


def solve(body, positions, **kwargs):
    return SimplexSolver(SimplexSettings(**kwargs), body).solve(positions, [], CAMERAS, 0.0)


def euler_zyx(alpha, beta, gamma):
    turn = [RigidTransform.from_rotvec(v).rotation for v in np.diag([alpha, beta, gamma])]
    return turn[2] @ turn[1] @ turn[0]


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=["paper", "four"])
@pytest.mark.parametrize("sd_mm", [0.3, 2.0])
def test_minimum_is_that_of_the_closed_form(body, sd_mm):
    rng = np.random.default_rng(3)
    for _ in range(15):
        positions = fixes_of(body, a_pose(rng, turn_deg=180), sd_mm, rng)
        pose = solve(body, positions)
        exact = align_points([position.center for position in positions], body.centers)
        difference = pose.world_from_body.difference(exact)
        assert np.linalg.norm(difference[:3]) < 1e-4
        assert np.linalg.norm(difference[3:]) < 1e-5
        assert pose.flags == ()


@settings(deadline=None, max_examples=25)
@given(
    st.floats(-3.1, 3.1),
    st.one_of(st.floats(1.5, 1.65), st.floats(-1.65, -1.5), st.just(np.pi / 2)),
    st.floats(-3.1, 3.1),
)
def test_no_trouble_near_gimbal_lock(alpha, beta, gamma):
    pose = RigidTransform(euler_zyx(alpha, beta, gamma), np.array([30.0, -20.0, 250.0]))
    positions = fixes_of(RAVEN, pose, 0.5, np.random.default_rng(4))
    exact = align_points([position.center for position in positions], RAVEN.centers)
    difference = solve(RAVEN, positions).world_from_body.difference(exact)
    assert np.linalg.norm(difference[:3]) < 1e-4
    assert np.linalg.norm(difference[3:]) < 1e-5


def test_two_fixes_give_no_pose():
    pose = a_pose(np.random.default_rng(5))
    assert solve(RAVEN, fixes_of(RAVEN, pose, names=["green", "red"])) is None


def test_fixes_on_one_line_give_no_pose():
    positions = fixes_of(RAVEN, RigidTransform.identity())
    flat = [
        BallPosition(f.ball, 0.0, f.center * [1, 0, 0], f.covariance, f.cameras, f.residuals_mm)
        for f in positions
    ]
    assert solve(RAVEN, flat) is None
    with pytest.raises(DegenerateGeometryError, match="one line"):
        initial_guess(np.stack([f.center for f in flat]), RAVEN.centers)


def test_too_few_evaluations_are_flagged():
    rng = np.random.default_rng(6)
    pose = solve(RAVEN, fixes_of(RAVEN, a_pose(rng), 2.0, rng), max_evaluations=100)
    assert pose.flags == ("the simplex search did not converge",)


def test_wrong_shape_shows_in_the_residual():
    pose = a_pose(np.random.default_rng(7))
    positions = fixes_of(RAVEN, pose)
    assert solve(RAVEN, positions).residual_mm < 1e-4
    stretched = [
        BallPosition(f.ball, 0.0, f.center, f.covariance, f.cameras, f.residuals_mm)
        for f in positions
    ]
    along = positions[0].center - positions[2].center
    off = positions[0].center + 6.0 * along / np.linalg.norm(along)
    stretched[0] = BallPosition("green", 0.0, off, np.eye(3), tuple(CAMERAS), np.zeros(4))
    assert solve(RAVEN, stretched).residual_mm > 2.0


def test_reported_covariance_is_the_scatter_of_the_whole_chain():
    """Pixels with known noise -> midpoint -> simplex, against truth."""
    rng = np.random.default_rng(11)
    pose = a_pose(rng)
    midpoint = MidpointTriangulator(MidpointSettings())
    solver = SimplexSolver(SimplexSettings(), RAVEN)
    errors, covariances = [], []
    for _ in range(150):
        seen = see(CAMERAS, RAVEN, pose, 0.8, rng)
        positions = [midpoint.triangulate(of_ball(seen, name), CAMERAS) for name in RAVEN.names]
        found = solver.solve(positions, seen, CAMERAS, 0.0)
        errors.append(found.world_from_body.difference(pose))
        covariances.append(found.covariance)
    distances = squared_mahalanobis(np.array(errors), np.array(covariances))
    assert distances.mean() == pytest.approx(6.0, rel=0.2)
    assert found.rms_px == pytest.approx(0.8 * np.sqrt(2), rel=0.5)
