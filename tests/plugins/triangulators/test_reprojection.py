from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform, squared_mahalanobis
from measure.host import Settings
from measure_plugins.triangulators.dlt import DltTriangulator
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.scenes import RAVEN, a_pose, of_ball, ring, see, strayed

POSE_COVARIANCE = np.diag([0.3, 0.3, 0.3, 5e-4, 5e-4, 5e-4]) ** 2


def reprojection(**settings):
    return ReprojectionTriangulator(ReprojectionConfig(**settings))


def errors(triangulator, cameras, sd_px, draws, seed=1):
    """Errors (draws, 3) and reported covariances (draws, 3, 3) over random points and noise."""
    rng = np.random.default_rng(seed)
    out, covariances = [], []
    for _ in range(draws):
        pose = a_pose(rng)
        seen = of_ball(see(cameras, RAVEN, pose, sd_px, rng), "yellow")
        position = triangulator.triangulate(seen, cameras)
        out.append(position.center - pose.apply(RAVEN.centers)[1])
        covariances.append(position.covariance)
    return np.array(out), np.array(covariances)


@pytest.mark.parametrize(
    "triangulator", [reprojection(), DltTriangulator(Settings())], ids=["reprojection", "dlt"]
)
def test_covariance_matches_monte_carlo(triangulator):
    error, covariance = errors(triangulator, ring(), 0.3, 600)
    distance = squared_mahalanobis(error, covariance)
    assert np.mean(distance) == pytest.approx(3.0, rel=0.12)
    assert np.mean(distance < 7.815) == pytest.approx(0.95, abs=0.03)


def test_covariance_includes_the_camera_poses():
    rng = np.random.default_rng(5)
    known = ring(pose_covariance=POSE_COVARIANCE)
    distance = []
    for _ in range(400):
        true = strayed(known, rng)
        pose = a_pose(rng)
        seen = of_ball(see(true, RAVEN, pose, 0.1, rng), "red")
        position = reprojection().triangulate(seen, known)
        error = position.center - pose.apply(RAVEN.centers)[2]
        distance.append(squared_mahalanobis(error, position.covariance))
    assert np.mean(distance) == pytest.approx(3.0, rel=0.2)
    seen = of_ball(see(known, RAVEN, pose, 0.1), "red")
    position = reprojection().triangulate(seen, known)
    sure = reprojection().triangulate(seen, ring())
    assert np.trace(position.covariance) > 3 * np.trace(sure.covariance)


def test_weights_beat_equal_weights():
    """One camera ten times as noisy as the others: its say must shrink, not spoil the position."""
    rng = np.random.default_rng(7)
    cameras = ring()
    methods = {"weighted": reprojection(), "dlt": DltTriangulator(Settings())}
    squares = {name: [] for name in methods}
    for _ in range(150):
        pose = a_pose(rng)
        seen = of_ball(see(cameras, RAVEN, pose, 0.1, rng), "green")
        bad = seen[1]
        seen[1] = replace(
            bad, center_px=bad.center_px + rng.normal(scale=2, size=2), covariance_px=4 * np.eye(2)
        )
        truth = pose.apply(RAVEN.centers)[0]
        for name, triangulator in methods.items():
            position = triangulator.triangulate(seen, cameras)
            squares[name].append(np.sum((position.center - truth) ** 2))
    assert np.mean(squares["weighted"]) < 0.2 * np.mean(squares["dlt"])


@pytest.mark.parametrize("wrong", ["cam0", "cam1", "cam2", "cam3"])
def test_names_the_camera_it_drops(wrong):
    cameras = ring()
    pose = a_pose(np.random.default_rng(11))
    seen = of_ball(see(cameras, RAVEN, pose, 0.1, np.random.default_rng(2)), "red")
    seen = [
        replace(d, center_px=d.center_px + np.array([20.0, -15.0])) if d.camera == wrong else d
        for d in seen
    ]
    position = reprojection().triangulate(seen, cameras)
    assert position.dropped == (wrong,)
    assert wrong not in position.cameras
    assert np.linalg.norm(position.center - pose.apply(RAVEN.centers)[2]) < 0.2


def test_two_cameras_that_disagree_are_not_believed():
    cameras = dict(list(ring().items())[:2])
    pose = a_pose(np.random.default_rng(11))
    seen = of_ball(see(cameras, RAVEN, pose, 0.1), "red")
    agreed = reprojection().triangulate(seen, cameras)
    seen[1] = replace(seen[1], center_px=seen[1].center_px + np.array([0.0, 12.0]))
    position = reprojection().triangulate(seen, cameras)
    error = np.linalg.norm(position.center - pose.apply(RAVEN.centers)[2])
    assert error > 1
    assert np.sqrt(np.trace(position.covariance)) > 20 * np.sqrt(np.trace(agreed.covariance))


def test_three_cameras_that_cannot_tell_who_is_wrong_say_so():
    """An error along one epipolar line passes with either partner: the answers' gap is reported."""
    cameras = dict(list(ring().items())[:3])
    pose = a_pose(np.random.default_rng(12))
    truth = pose.apply(RAVEN.centers)[2]
    seen = of_ball(see(cameras, RAVEN, pose, 0.1), "red")
    along = cameras["cam0"].center - truth
    false = cameras["cam1"].project([truth + 0.05 * along])[0]
    seen[1] = replace(seen[1], center_px=false)
    position = reprojection().triangulate(seen, cameras)
    error = np.linalg.norm(position.center - truth)
    assert error < 3 * np.sqrt(np.trace(position.covariance))
    assert len(position.dropped) == 1


def test_point_behind_a_camera_is_none_or_drops_it():
    cameras = ring()
    seen = of_ball(see(cameras, RAVEN, a_pose(np.random.default_rng(1))), "red")
    turned = cameras["cam2"].world_from_camera
    flipped = replace(
        cameras["cam2"],
        world_from_camera=RigidTransform(
            turned.rotation @ np.diag([1.0, -1, -1]), turned.translation
        ),
    )
    position = reprojection().triangulate(seen, {**cameras, "cam2": flipped})
    assert position.dropped == ("cam2",)
