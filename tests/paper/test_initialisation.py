"""The choice of circles at a start, among distractors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scenes import RAVEN, TARGET, a_pose, ring, see

from measure.geometry import RigidTransform
from measure.model import Ball, Body
from measure_paper.tracking.ray_agreement import (
    AgreementLimits,
    choose,
    disagreeing,
    locate,
    ray_observations,
)

CAMERAS = ring(4)
LIMITS = AgreementLimits(3.0, 0.1)


def chosen_points(detections, tolerance_mm=6.0):
    found = choose(RAVEN, ray_observations(detections, CAMERAS), LIMITS, tolerance_mm)
    return {name: hypothesis.point for name, hypothesis in found.items()}, found


def test_clean_circles_are_all_chosen():
    pose = a_pose(np.random.default_rng(0))
    points, found = chosen_points(see(CAMERAS, RAVEN, pose, 0.5))
    np.testing.assert_allclose(
        [points[n] for n in RAVEN.names], pose.apply(RAVEN.centers), atol=1e-6
    )
    assert all(set(hypothesis.members) == set(CAMERAS) for hypothesis in found.values())


def test_a_real_ball_of_the_same_colour_elsewhere_is_not_taken():
    """A distractor that all cameras see, listed first, at the wrong distance from the others."""
    pose = a_pose(np.random.default_rng(1))
    decoy = Body("decoy", tuple(Ball(b.name, b.color, b.center_mm, 20.0) for b in RAVEN.balls))
    away = RigidTransform(np.eye(3), TARGET + np.array([0.0, 150.0, 20.0]))
    decoys = [d for d in see(CAMERAS, decoy, away, 0.5) if d.ball == "red"]
    points, found = chosen_points(decoys + see(CAMERAS, RAVEN, pose, 0.5))
    np.testing.assert_allclose(
        [points[n] for n in RAVEN.names], pose.apply(RAVEN.centers), atol=1e-6
    )
    assert not any(d in decoys for h in found.values() for d in h.members.values())


def test_a_ball_of_another_size_is_not_taken():
    pose = a_pose(np.random.default_rng(2))
    large = [replace(d, radius_px=1.3 * d.radius_px) for d in see(CAMERAS, RAVEN, pose, 0.5)]
    assert chosen_points(large)[0] == {}


def test_circles_of_one_camera_are_not_chosen():
    pose = a_pose(np.random.default_rng(3))
    lone = [d for d in see(CAMERAS, RAVEN, pose, 0.5) if d.camera == "cam0"]
    assert chosen_points(lone)[0] == {}


def test_outliers_are_named_worst_first_if_three_circles():
    pose = a_pose(np.random.default_rng(4))
    seen = [d for d in see(CAMERAS, RAVEN, pose, 0.5) if d.ball == "green"]
    seen[1] = replace(seen[1], center_px=seen[1].center_px + np.array([40.0, 0]))
    rays = ray_observations(seen, CAMERAS)
    assert [s.camera.name for s in disagreeing(rays, 20.0, LIMITS)] == ["cam1"]
    assert disagreeing(rays[:2], 20.0, LIMITS) == ()
    assert disagreeing(rays[2:], 20.0, LIMITS) == ()
    assert locate(rays[:1]) is None
