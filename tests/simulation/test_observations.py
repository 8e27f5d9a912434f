"""Observations without pictures: exact but for the stated noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import tangent_cone
from measure.simulation import Still
from measure.simulation.catalogue import plain_scene
from tests.simulated.catalogue import async_scene, occluded_scene
from tests.simulated.observations import Observation, simulate_observations


def true_center(scene, detection):
    ball = scene.body.balls[scene.body.index(detection.ball)]
    pose = scene.trajectory.at(detection.time_s)
    return pose.apply(ball.center_mm), ball.radius_mm


def test_without_noise_everything_is_exact() -> None:
    scene = async_scene()
    found = simulate_observations(scene, 0.3, Observation(noise_px=0.0))
    assert len(found) >= 9
    for detection in found:
        camera = scene.camera(detection.camera)
        center, radius = true_center(scene, detection)
        assert np.abs(detection.center_px - camera.project(center[None])[0]).max() < 1e-5
        cone = tangent_cone(camera.camera_from_world.apply(center), radius)
        assert (
            np.abs(cone.residuals(camera.intrinsics.unproject(detection.outline_px))).max() < 1e-9
        )
        assert detection.time_s == pytest.approx(0.3 + scene.phases_s[detection.camera])


def test_hidden_outline_points_are_left_out() -> None:
    scene = occluded_scene()
    bare = replace(scene, attached=(), fixed=())
    how = Observation(min_share=0.0)
    times = np.linspace(0, 3, 12)
    hidden = sum(len(d.outline_px) for t in times for d in simulate_observations(scene, t, how))
    free = sum(len(d.outline_px) for t in times for d in simulate_observations(bare, t, how))
    assert 0.6 * free < hidden < 0.97 * free
    assert free < 12 * 12 * 64, "balls hide each other"


def test_scatter_of_centers_is_the_stated_covariance() -> None:
    scene = plain_scene()
    still = replace(scene, trajectory=Still(scene.trajectory.at(0.0)), attached=())
    how = Observation(noise_px=0.3)
    squared = []
    for seed in range(60):
        for d in simulate_observations(still, 0.0, how, seed):
            center, _ = true_center(still, d)
            off = d.center_px - still.camera(d.camera).project(center[None])[0]
            squared.append(off @ np.linalg.solve(d.covariance_px, off))
    assert np.mean(squared) == pytest.approx(2.0, rel=0.12)


def test_observations_repeat_with_the_seed() -> None:
    scene = plain_scene()
    a, b, c = (simulate_observations(scene, 0.1, seed=s) for s in (1, 1, 2))
    assert all(np.array_equal(x.center_px, y.center_px) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a[0].center_px, c[0].center_px)
