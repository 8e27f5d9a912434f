"""A truth on another clock, in other frames, is brought to the run by motion, or refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.results.truth_alignment import align_truth
from measure.session import Trajectory
from tests.results.conftest import true_pose

SD = np.array([0.05, 0.05, 0.05, 0.002, 0.002, 0.002])
THERE = RigidTransform.from_rotvec([1.2, -0.7, 2.0], [1000.0, -300.0, 20.0])
ON_BODY = RigidTransform.from_rotvec([-0.3, 1.5, 0.2], [10.0, -40.0, 30.0])


def poses(path, times_s):
    each = [path(time_s) for time_s in times_s]
    return RigidTransform(
        np.stack([p.rotation for p in each]), np.stack([p.translation for p in each])
    )


def made(path, offset_s, seed=0, world=None, body=None):
    """A run of 2 s at 30 Hz, and the truth of 4 s at 120 Hz on a clock that is behind."""
    times, dense = 1.0 + np.arange(60) / 30, np.arange(480) / 120
    noise = np.random.default_rng(seed).normal(size=(60, 6)) * SD
    run = SimpleNamespace(
        times_s=times,
        has_pose=np.ones(60, bool),
        world_from_body=poses(path, times).perturb(noise),
        path="run",
    )
    true = poses(path, dense)
    if world is not None:
        true = world @ true @ body
    return run, Trajectory(dense - offset_s, true, "truth")


@pytest.mark.parametrize("offset_s", [0.0, 0.123, -17.3])
def test_the_clock_is_found_and_frames_that_are_the_same_stay(offset_s):
    run, truth = made(true_pose, offset_s)
    moved, found = align_truth(run, truth)
    assert abs(found.offset_s - offset_s) < 3 * found.sd_s
    assert found.sd_s < 0.001
    assert not found.frames_fitted
    np.testing.assert_array_equal(
        moved.world_from_body.translation, truth.world_from_body.translation
    )


def test_other_frames_are_fitted():
    errors = []
    for seed in range(2):
        run, truth = made(true_pose, 2.5, seed, THERE, ON_BODY)
        moved, found = align_truth(run, truth)
        assert found.frames_fitted
        errors.append((found.offset_s - 2.5) / found.sd_s)
        left = run.world_from_body.difference(moved.at(run.times_s))
        assert np.all(np.sqrt(np.mean(left**2, axis=0)) < 1.3 * SD)
    assert max(map(abs, errors)) < 3


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (lambda t: true_pose(0.3), "does the body move"),
        (lambda t: true_pose(0.2 * np.sin(4 * np.pi * t)), "alike, as it repeats itself"),
    ],
    ids=["still", "to and fro"],
)
def test_a_motion_that_does_not_tell_is_refused(path, said):
    run, truth = made(path, 0.5)
    with pytest.raises(RunError, match=said):
        align_truth(run, truth)


def test_the_truth_of_another_motion_is_refused():
    run, _ = made(true_pose, 0.0)
    _, other = made(lambda t: true_pose(3 * np.cos(1.7 * t) + 5), 0.0)
    with pytest.raises(RunError, match="no offset makes truth move as run does"):
        align_truth(run, other)
