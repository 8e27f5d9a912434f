"""Motions keep to their limits and are exact at any time."""

from __future__ import annotations

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.simulation import MotionLimits, Still, random_motion

MIDDLE = RigidTransform(np.eye(3), np.array([0.0, 0.0, 250.0]))


@pytest.mark.parametrize("seed", range(5))
def test_random_motion_keeps_to_its_limits(seed: int) -> None:
    limits = MotionLimits()
    motion = random_motion(seed, MIDDLE, limits)
    step = 1e-3
    poses = motion.at(np.arange(0.0, 60.0, step))
    off = poses.difference(MIDDLE)
    assert (np.abs(off[:, :3]).max(axis=0) <= limits.reach_mm).all()
    assert np.linalg.norm(off[:, 3:], axis=1).max() <= limits.angle_rad
    speed = np.linalg.norm(np.diff(poses.translation, axis=0), axis=1) / step
    assert speed.max() <= limits.speed_mm_s * 1.0001
    assert speed.max() > 0.2 * limits.speed_mm_s, "it does move"


def test_motion_is_smooth_and_repeats_with_the_seed() -> None:
    a, b = random_motion(7, MIDDLE), random_motion(7, MIDDLE)
    times = np.linspace(0, 3, 400)
    assert np.array_equal(a.at(times).matrix, b.at(times).matrix)
    assert np.array_equal(a.at(1.5).matrix, a.at(np.array([1.5])).matrix[0])
    second = np.diff(a.at(times).translation, 2, axis=0) / (times[1] ** 2)
    assert np.abs(second).max() < 500


def test_still_body_has_the_shape_of_the_times() -> None:
    still = Still(MIDDLE)
    assert still.at(0.3).translation.shape == (3,)
    assert still.at(np.zeros((2, 4))).rotation.shape == (2, 4, 3, 3)
