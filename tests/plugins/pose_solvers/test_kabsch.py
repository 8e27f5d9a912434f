from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform, squared_mahalanobis
from measure.model import Body, Motion
from measure_plugins.pose_solvers.kabsch import KabschConfig, KabschSolver
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.scenes import FOUR, RAVEN, a_pose, displaced, of_ball, ring, see, strayed

TRIANGULATOR = ReprojectionTriangulator(ReprojectionConfig())
POSE_COVARIANCE = np.diag([0.3, 0.3, 0.3, 5e-4, 5e-4, 5e-4]) ** 2


def solve(body, seen, cameras, time_s=0.0, prior=None, skip_balls=()):
    positions = [
        position
        for name in body.names
        if name not in skip_balls
        and (position := TRIANGULATOR.triangulate(of_ball(seen, name), cameras)) is not None
    ]
    return KabschSolver(KabschConfig(), body).solve(positions, seen, cameras, time_s, prior)


def test_covariance_matches_monte_carlo():
    rng = np.random.default_rng(3)
    cameras = ring()
    distance = []
    for _ in range(400):
        truth = a_pose(rng)
        pose = solve(RAVEN, see(cameras, RAVEN, truth, 0.2, rng), cameras)
        error = pose.world_from_body.difference(truth)
        distance.append(squared_mahalanobis(error, pose.covariance))
        assert pose.flags == ()
    assert np.mean(distance) == pytest.approx(6.0, rel=0.12)
    assert np.mean(np.array(distance) < 12.59) == pytest.approx(0.95, abs=0.03)


def test_calibration_errors_are_shared_by_all_balls():
    """A camera's pose error moves all positions together; independent, it would be too sure."""
    rng = np.random.default_rng(4)
    known = ring(pose_covariance=POSE_COVARIANCE)
    distance = []
    for _ in range(300):
        true = strayed(known, rng)
        truth = a_pose(rng)
        pose = solve(RAVEN, see(true, RAVEN, truth, 0.1, rng), known)
        distance.append(
            squared_mahalanobis(pose.world_from_body.difference(truth), pose.covariance)
        )
    assert np.mean(distance) == pytest.approx(6.0, rel=0.2)


def test_own_times_are_used_when_the_motion_is_known():
    cameras = ring()
    start = a_pose(np.random.default_rng(5))
    velocity = np.array([60.0, -20, 10, 0.5, 0.2, -0.4])
    motion = Motion(start, 0.0, velocity)
    seen = see(cameras, RAVEN, motion.at, time_s=np.array([-0.012, 0.004, 0.009, 0.015]))
    still = solve(RAVEN, seen, cameras)
    known = solve(RAVEN, seen, cameras, prior=motion)
    assert np.linalg.norm(still.world_from_body.translation - start.translation) > 0.1
    assert np.linalg.norm(known.world_from_body.translation - start.translation) < 0.01


def test_one_bad_ball_of_four_is_outvoted_and_flagged():
    cameras = ring()
    truth = a_pose(np.random.default_rng(6))
    rng = np.random.default_rng(7)
    seen = see(cameras, FOUR, truth, 0.1, rng)
    pose = solve(displaced(FOUR, FOUR.names[0], [3.0, 0, 0]), seen, cameras)
    assert any("white" in flag and "mm apart" in flag for flag in pose.flags)
    assert all("white" in flag for flag in pose.flags)
    error = pose.world_from_body.difference(truth)
    assert squared_mahalanobis(error, pose.covariance) < 16


def test_wrong_ball_distances_are_flagged():
    cameras = ring()
    truth = a_pose(np.random.default_rng(6))
    file = Body("33 mm", tuple(replace(b, center_mm=b.center_mm * 33 / 38) for b in RAVEN.balls))
    pose = solve(file, see(cameras, RAVEN, truth, 0.1, np.random.default_rng(1)), cameras)
    assert "balls green and red are 76.0 mm apart, the body says 66.0 mm" in pose.flags


def test_a_mirrored_body_is_flagged():
    cameras = ring()
    truth = a_pose(np.random.default_rng(6))
    file = Body("mirror", tuple(replace(b, center_mm=b.center_mm * [1, 1, -1]) for b in FOUR.balls))
    pose = solve(file, see(cameras, FOUR, truth, 0.1, np.random.default_rng(1)), cameras)
    assert pose.flags == ("the balls form the mirror image of the body",)


def test_too_few_fixes_or_a_line_is_none():
    cameras = ring()
    truth = RigidTransform(np.eye(3), np.array([0, 0, 250.0]))
    seen = see(cameras, RAVEN, truth)
    assert solve(RAVEN, seen, cameras, skip_balls=("red",)) is None
    assert KabschSolver(KabschConfig(), RAVEN).solve([], [], cameras, 0.0) is None
