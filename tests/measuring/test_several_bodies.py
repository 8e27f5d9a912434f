"""The pose of one body relative to another: its place, and what both share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status, relative_measurement
from measure.model import BallView, Detection, Pose
from measure.model.observations import State
from tests.scenes import RAVEN, ring

BASE = replace(RAVEN, name="base")
HERE = RigidTransform.from_rotvec(np.array([0.3, -0.2, 0.9]), np.array([60.0, -20.0, 250.0]))
THERE = RigidTransform.from_rotvec(np.array([-0.4, 0.1, 0.2]), np.array([-50.0, 10.0, 230.0]))


def measurement(pose, covariance=None, levers=None, flags=(), status=Status.OK):
    found = pose and Pose(0.0, pose, covariance, 0.1, 0.2, ("cam0",), RAVEN.names, flags, levers)
    return Measurement(3, 0.0, {"cam0": 3}, (), (), found, status)


def relative(one, other, cameras=()):
    return relative_measurement((RAVEN, one), (BASE, other), cameras)


def test_covariance_is_the_scatter_of_relative_poses():
    rng = np.random.default_rng(1)
    root = np.diag([0.05, 0.04, 0.08, 1e-3, 2e-3, 1e-3]) @ rng.normal(size=(6, 6))
    one, other = (
        root @ root.T,
        0.5 * root[:, ::-1] @ np.diag([1, 2, 0.5, 1, 1, 3]) @ root[:, ::-1].T,
    )
    found = relative(measurement(HERE, one), measurement(THERE, other)).pose
    draws = [
        (THERE.perturb(b).inverse() @ HERE.perturb(a)).difference(found.world_from_body)
        for a, b in zip(
            rng.multivariate_normal(np.zeros(6), one, 4000),
            rng.multivariate_normal(np.zeros(6), other, 4000),
            strict=True,
        )
    ]
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance), np.array(draws).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.12)


@pytest.mark.parametrize(("together", "share"), [(True, 1e-9), (False, 1.0)])
def test_an_error_that_moves_both_as_one_thing_cancels(together, share):
    """A camera that turns the world about its centre turns both bodies; or one of them only."""
    camera = replace(ring(1)["cam0"], pose_covariance=np.diag([0.3**2] * 3 + [1e-3**2] * 3))

    def lever(pose):
        arm = pose.translation - camera.center
        out = np.eye(6, 18)
        out[:3, 3:6] = np.cross(np.eye(3), arm).T
        return out

    levers = [{"cam0": lever(pose)} for pose in (HERE, THERE)]
    poses = [
        measurement(pose, lever["cam0"] @ camera.covariance @ lever["cam0"].T, lever)
        for pose, lever in zip((HERE, THERE), levers, strict=True)
    ]
    if not together:
        poses[1] = replace(poses[1], pose=replace(poses[1].pose, by_camera=None))
    found = relative(*poses, (camera,)).pose.covariance
    alone = relative(poses[0], replace(poses[1], pose=replace(poses[1].pose, by_camera=None)))
    assert np.trace(found) == pytest.approx(share * np.trace(alone.pose.covariance), abs=1e-7)


def test_without_either_there_is_none_and_flags_say_whose():
    good, lost = measurement(HERE, np.eye(6)), measurement(None, status=Status.LOST)
    found = relative(good, lost)
    assert (found.status, found.pose, found.reason) == (Status.LOST, None, "base: lost")
    (doubt,) = relative(lost, good).doubts
    assert doubt.plain == {"code": "no-pose", "status": "lost", "body": "raven"}
    doubtful = measurement(THERE, np.eye(6), flags=("jumped",), status=Status.FLAGGED)
    flagged = relative(good, doubtful)
    assert flagged.status is Status.FLAGGED
    assert flagged.pose.flags == ("base: jumped",)


def _solved(places, seen, cameras, known_by):
    """Poses that fit centres seen best, with deviations of the cameras as unknowns of their own.

    Args:
        seen: by body, then camera: centres (3, 2) px, known to 0.1 px.
        known_by: whether the deviations are those of one body alone, or common to all.
    """
    sd = np.sqrt(np.diagonal(cameras[0].pose_covariance))
    count = len(known_by)

    def moved(x, index):
        return places[index].perturb(x[6 * index : 6 * index + 6])

    def off(x):
        deviations = x[12:].reshape(count, len(cameras), 6)
        parts = [deviations.ravel()]
        for group, bodies in enumerate(known_by):
            for index in bodies:
                points = moved(x, index).apply(RAVEN.centers)
                for i, camera in enumerate(cameras):
                    there = camera.world_from_camera.perturb(deviations[group, i] * sd)
                    parts.append(
                        (
                            seen[index][i]
                            - replace(camera, world_from_camera=there).project(points)
                        ).ravel()
                        / 0.1
                    )
        return np.concatenate(parts)

    x = least_squares(off, np.zeros(12 + count * len(cameras) * 6), x_scale="jac").x
    return [moved(x, index) for index in (0, 1)]


SD = np.array([*[0.3] * 3, *np.radians([0.03] * 3)])


def _moved_cameras(true):
    """The cameras elsewhere by a draw of what their calibration states."""
    rng = np.random.default_rng(7)
    return [
        replace(
            camera,
            world_from_camera=camera.world_from_camera.perturb(SD * rng.normal(size=6)),
            pose_covariance=np.diag(SD**2),
        )
        for camera in true
    ]


def _observed(pose, centers, cameras, balls=RAVEN.names):
    """A pose, and some balls' centres (3, 2) px as each camera sees them."""
    views, off = [], {}
    for camera, pixels in zip(cameras, centers, strict=True):
        predicted = camera.project(pose.apply(RAVEN.centers))
        for ball, pixel, there in zip(RAVEN.names, pixels, predicted, strict=True):
            if ball in balls:
                found = Detection(ball, camera.name, 0.0, pixel, 20.0, np.eye(2) * 0.01)
                views.append(BallView(ball, camera.name, State.EFFECTIVE, detection=found))
                off[ball, camera.name] = pixel - there
    one = measurement(pose, np.diag([0.3**2] * 3 + [3e-3**2] * 3))
    return replace(one, views=tuple(views), residuals_px=off)


def test_two_bodies_agree_about_the_cameras_that_see_both():
    """As if both were solved in one problem, from poses solved alone; and nearer to the truth."""
    true = list(ring(3).values())
    cameras, places = _moved_cameras(true), [HERE, THERE]
    seen = [[c.project(p.apply(RAVEN.centers)) for c in true] for p in places]
    alone = _solved(places, seen, cameras, [[0], [1]])
    together = _solved(places, seen, cameras, [[0, 1]])
    measured = [_observed(*one, cameras) for one in zip(alone, seen, strict=True)]
    found = relative(*measured, cameras).pose
    expected = together[1].inverse() @ together[0]
    apart = alone[1].inverse() @ alone[0]
    step = apart.difference(expected)
    left = found.world_from_body.difference(expected)
    assert np.linalg.norm(step[:3]) > 0.05
    assert np.linalg.norm(left[:3]) < 0.03 * np.linalg.norm(step[:3])
    truth = THERE.inverse() @ HERE
    error, before = (p.difference(truth)[:3] for p in (found.world_from_body, apart))
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(before)
    exact = [replace(camera, pose_covariance=None) for camera in cameras]
    unmoved = relative(*measured, exact).pose.world_from_body
    np.testing.assert_allclose(unmoved.matrix, apart.matrix, atol=1e-12)


@pytest.mark.parametrize("balls", [RAVEN.names[:2], RAVEN.names[:1]])
def test_a_body_whose_centres_do_not_tell_its_pose_is_left_as_it_was_solved(balls):
    true = list(ring(4).values())
    cameras = _moved_cameras(true)
    seen = [[c.project(p.apply(RAVEN.centers)) for c in true] for p in (HERE, THERE)]
    measured = _observed(HERE, seen[0], cameras, balls), _observed(THERE, seen[1], cameras)
    exact = [replace(camera, pose_covariance=None) for camera in cameras]
    found, solved = (relative(*measured, some).pose for some in (cameras, exact))
    np.testing.assert_allclose(found.world_from_body.matrix, solved.world_from_body.matrix)
    np.testing.assert_allclose(found.covariance, solved.covariance)
