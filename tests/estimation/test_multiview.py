"""One point in several cameras: the compiled sums against the formulas they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.estimation.multiview import PointObservations, calibration_noise, fit_point
from measure.estimation.pose_fit import fit_pose
from measure.geometry import RigidTransform, propagate
from measure.measuring.measurement import FrameSetObservations
from measure.model import BallView, Camera, Detection, Motion, Pose, Rig
from measure.model.observations import State
from tests.scenes import RAVEN, TARGET, ring, see

_POSE = np.diag([0.1, 0.2, 0.3, 1e-3, 2e-3, 3e-3]) ** 2 + 1e-8
_LENS = np.diag(np.r_[1.0, 1.2, 0.5, 0.7, np.full(8, 1e-3)]) ** 2 + 1e-9


def _uncertain(camera: Camera) -> Camera:
    lens = replace(camera.intrinsics, distortion=np.array([0.06, -0.12, 1e-3, -2e-3, 0.02]))
    sd_pose, sd_lens = np.sqrt(np.diag(_POSE)), np.sqrt(np.diag(_LENS))
    return replace(
        camera,
        intrinsics=replace(lens, covariance=_LENS),
        pose_covariance=_POSE,
        pose_intrinsics_covariance=0.02 * np.outer(sd_pose, sd_lens),
    )


def _seen(cameras: dict[str, Camera], time_s: float = 0.0) -> list[Detection]:
    return [
        Detection("red", name, time_s, camera.project(TARGET[None])[0], 50.0, 0.01 * np.eye(2))
        for name, camera in cameras.items()
    ]


def test_a_calibrations_uncertainty_is_propagated_by_the_cameras_own_jacobians():
    cameras = {name: _uncertain(camera) for name, camera in ring().items()}
    views = PointObservations.of(_seen(cameras), cameras)
    for i, camera in enumerate(cameras.values()):
        _, _, by_pose, by_lens = camera.project_with_jacobians(TARGET[None])
        both = np.concatenate([by_pose, by_lens], axis=2)[0]
        np.testing.assert_allclose(views.by_camera(TARGET)[i], both, atol=1e-9)
        joint = camera.covariance
        assert np.any(joint[:6, 6:])
        np.testing.assert_allclose(calibration_noise(views.rig, TARGET)[i], propagate(both, joint))


@pytest.mark.parametrize("axis", [0, 3, 5])
def test_cameras_of_which_one_thing_alone_is_uncertain_are_uncertain(axis):
    """A covariance of turns alone begins with zeros."""
    cameras = ring(pose_covariance=np.diag(np.eye(6)[axis] * 1e-6))
    noise = calibration_noise(Rig.of(list(cameras.values())), TARGET)
    assert np.all(np.trace(noise, axis1=1, axis2=2) > 1e-9)


def test_a_fit_weighs_as_it_says():
    cameras = {name: _uncertain(camera) for name, camera in ring().items()}
    seen = [
        replace(d, center_px=d.center_px + 0.3 * np.random.default_rng(i).normal(size=2))
        for i, d in enumerate(_seen(cameras))
    ]
    views = PointObservations.of(seen, cameras)
    fit = fit_point(views)
    residuals, by_point = views.residuals(fit.point)
    weight = np.linalg.inv(views.total_noise(fit.point))
    gradient = np.einsum("nia,nij,nj->a", by_point, weight, residuals)
    information = np.einsum("nia,nij,njb->ab", by_point, weight, by_point)
    size = np.sqrt(np.diag(information))
    assert np.max(np.abs(gradient / size)) < 1e-2, "the weights are those of a point near by"
    np.testing.assert_allclose(fit.covariance @ information, np.eye(3), atol=1e-2)


def test_a_point_behind_a_camera_is_refused():
    two = list(ring().values())[:2]
    cameras = {c.name: replace(c, world_from_camera=_turned_round(c)) for c in two}
    seen = [replace(d, center_px=p) for d, p in zip(_seen(ring())[:2], _pixels(two), strict=True)]
    with pytest.raises(DegenerateGeometryError, match="behind"):
        fit_point(PointObservations.of(seen, cameras))


def _turned_round(camera: Camera) -> RigidTransform:
    """Looking the other way: the same line of sight meets the point behind the camera."""
    return RigidTransform(camera.world_from_camera.rotation * [-1.0, 1.0, -1.0], camera.center)


def _pixels(cameras: list[Camera]) -> list[Floats]:
    return [camera.intrinsics.matrix[:2, 2] for camera in cameras]


def test_detections_are_carried_to_one_instant():
    cameras, velocity = ring(), np.array([40.0, -20, 10, 0.2, 0.4, -0.3])
    motion = Motion(RigidTransform.from_rotvec([0.1, 0.2, 0.3], TARGET), 1.0, velocity)
    times = {name: 1.0 + 0.01 * i for i, name in enumerate(cameras)}
    seen = [d for t in times.values() for d in see(cameras, RAVEN, motion.at(t), 0.0, time_s=t)]
    seen = [d for d in seen if d.time_s == times[d.camera]]
    assert len(seen) == 12
    views = [BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in seen]
    carried = FrameSetObservations.of(views, 1.0, RAVEN, cameras).at_instant(motion)
    truth = see(cameras, RAVEN, motion.at(1.0), 0.0, time_s=1.0)
    expected = {(d.ball, d.camera): d.center_px for d in truth}
    for before, after in zip(seen, carried, strict=True):
        assert (after.ball, after.camera, after.time_s) == (before.ball, before.camera, 1.0)
        np.testing.assert_allclose(after.center_px, expected[after.ball, after.camera], atol=1e-6)
    shifts = np.array([d.center_px for d in seen]) - [d.center_px for d in carried]
    assert np.max(np.abs(shifts)) > 1


def test_a_velocity_that_may_be_wrong_makes_the_pose_of_pictures_out_of_step_less_sure():
    """As much as the pose moves if detections are moved by a wrong velocity."""
    cameras = ring()
    still = RigidTransform.from_rotvec([0.1, 0.2, 0.3], TARGET)
    times = {name: 1.0 + 0.01 * i for i, name in enumerate(cameras)}
    found = [
        replace(d, time_s=times[d.camera], covariance_px=1e-4 * np.eye(2))
        for d in see(cameras, RAVEN, still, 0.0, time_s=1.0)
    ]
    views = [BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in found]
    pose = Pose(1.015, still, np.eye(6), 0.0, 0.0, (), ())
    seen, wrong = (
        FrameSetObservations.of(views, 1.015, RAVEN, cameras),
        np.diag([3.0, 0, 0, 0, 0.02, 0]),
    )
    share = seen.motion_covariance(pose, _moving(pose, np.zeros(6), velocity_covariance=wrong**2))
    for axis in (0, 4):
        fitted = fit_pose(still, seen.rows, np.eye(6)[axis] * wrong[axis, axis], 1e6)
        moved = fitted.world_from_body.difference(still)
        only = np.diag(np.eye(6)[axis]) * wrong[axis, axis] ** 2
        alone = seen.motion_covariance(pose, _moving(pose, np.zeros(6), velocity_covariance=only))
        np.testing.assert_allclose(alone, np.outer(moved, moved), atol=2e-2 * np.max(alone))
        share = share - alone
    np.testing.assert_allclose(share, 0, atol=1e-12)
    assert seen.motion_covariance(pose, _moving(pose, np.zeros(6))) is None


def _moving(pose: Pose, velocity: Floats, **known: Floats) -> Motion:
    return Motion(pose.world_from_body, pose.time_s, velocity, **known)
