from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, squared_mahalanobis, usable_pairs
from measure.geometry.rays import Rays
from measure_paper.midpoint import MidpointSettings, MidpointTriangulator
from tests.scenes import RAVEN, TARGET, a_pose, look_at, moved, of_ball, ring, see

MIDPOINT = MidpointTriangulator(MidpointSettings())


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_exact_without_noise(count):
    cameras = ring(count) if count != 2 else dict(list(ring(4).items())[:2])
    pose = a_pose(np.random.default_rng(3))
    position = MIDPOINT.triangulate(of_ball(see(cameras, RAVEN, pose), "green"), cameras)
    np.testing.assert_allclose(position.center, pose.apply(RAVEN.centers)[0], atol=1e-6)
    assert position.cameras == tuple(cameras)
    assert position.dropped == ()
    assert position.rms_mm < 1e-6


def beside(camera, angle_deg):
    """A camera whose rays meet those of `camera` at the target at `angle_deg`."""
    away = camera.center - TARGET
    turned = RigidTransform.from_rotvec([0, 0, np.radians(angle_deg)]).rotate(away)
    return replace(moved(camera, look_at(TARGET + turned)), name="beside")


def test_near_parallel_cameras_still_pair_with_a_third():
    cameras = ring(4)
    cameras = {"cam0": cameras["cam0"], "beside": beside(cameras["cam0"], 1.0), **cameras}
    cameras = {name: cameras[name] for name in ("cam0", "beside", "cam1")}
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(200):
        pose = a_pose(rng)
        position = MIDPOINT.triangulate(
            of_ball(see(cameras, RAVEN, pose, 0.5, rng), "red"), cameras
        )
        assert position.cameras == ("cam0", "beside", "cam1")
        errors.append(position.center - pose.apply(RAVEN.centers)[2])
    # The pair at one degree alone would err by more than 10 mm along the view.
    assert np.sqrt(np.mean(np.square(errors))) < 0.4


def test_parallel_rays_are_refused_with_the_angle():
    rays = Rays(np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([[0.0, 0, 1], [0, 0, 1.0]]))
    with pytest.raises(DegenerateGeometryError, match=r"none of 1 pairs .* 5.00 deg"):
        usable_pairs(rays, np.radians(5.0))


def test_rays_that_meet_behind_a_camera_give_no_fix():
    cameras = {name: ring(4)[name] for name in ("cam0", "cam1")}
    behind = look_at(cameras["cam1"].center, 2 * cameras["cam1"].center - TARGET)
    turned = {**cameras, "cam1": moved(cameras["cam1"], behind)}
    seen = of_ball(see(cameras, RAVEN, RigidTransform(np.eye(3), TARGET)), "yellow")
    assert MIDPOINT.triangulate(seen, cameras) is not None
    assert MIDPOINT.triangulate(seen, turned) is None


def test_camera_pose_covariance_counts():
    covariance = np.diag([0.4, 0.4, 0.4, 8e-4, 8e-4, 8e-4]) ** 2
    cameras = ring(4, pose_covariance=covariance)
    pose = a_pose(np.random.default_rng(8))
    truth = pose.apply(RAVEN.centers)[1]
    rng = np.random.default_rng(10)
    errors, distances = [], []
    for _ in range(400):
        off = {
            name: moved(
                camera,
                camera.world_from_camera.perturb(rng.multivariate_normal(np.zeros(6), covariance)),
            )
            for name, camera in cameras.items()
        }
        position = MIDPOINT.triangulate(
            of_ball(see(off, RAVEN, pose, 0.05, rng), "yellow"), cameras
        )
        errors.append(position.center - truth)
        distances.append(squared_mahalanobis(errors[-1], position.covariance))
    assert np.mean(distances) == pytest.approx(3.0, rel=0.15)
