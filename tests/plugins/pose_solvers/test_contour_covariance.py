"""What the joint fit of outlines says of its own uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import eval_legendre

from measure.geometry import squared_mahalanobis, tangent_cone
from measure.model import Camera, Intrinsics, Motion
from tests.plugins.pose_solvers.outlined import ANGLES, OFF, POSE, see, see_all, solve
from tests.scenes import RAVEN, moved, ring


@pytest.mark.parametrize(("common_px", "least"), [(0.05, 2.5), (0.0, 1.2)])
def test_covariance_holds_the_truth(common_px, least):
    """Outlines shifted one by one by 0.1 px, and each ball's in all cameras alike: by light."""
    cameras = ring()
    rng = np.random.default_rng(1)
    distances = []
    for _ in range(60):
        light = rng.normal(scale=common_px, size=(3, 3))
        seen = [
            see(RAVEN, camera, name, POSE, rng=rng, shift=_in_picture(camera, light[i], rng))
            for camera in cameras.values()
            for i, name in enumerate(RAVEN.names)
        ]
        pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
        error = pose.world_from_body.difference(POSE)
        distances.append(float(squared_mahalanobis(error, pose.covariance)))
    inside = np.mean(np.array(distances) < 12.59)  # 95 % of chi-square with 6 degrees
    assert 0.85 <= inside <= 1.0
    assert least < np.mean(distances) < 10.0


def inside_of(lights, seed):
    """How many positions lie in their 95 % regions where light shifts balls so (3, 3), in px."""
    cameras, rng, inside = ring(), np.random.default_rng(seed), 0
    for light in lights(rng):
        seen = [
            see(RAVEN, camera, name, POSE, sd=0.01, rng=rng, shift=_in_picture(camera, shift))
            for camera in cameras.values()
            for name, shift in zip(RAVEN.names, light, strict=True)
        ]
        pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
        off = pose.world_from_body.difference(POSE)[:3]
        inside += squared_mahalanobis(off, pose.covariance[:3, :3]) < 7.81
    return inside


def test_cameras_that_agree_do_not_promise_what_light_does_to_all_of_them():
    """Nothing but noise of 0.01 px tells the cameras apart, and light shifts balls by 0.08 px."""
    assert inside_of(lambda rng: (rng.normal(scale=0.08, size=(3, 3)) for _ in range(40)), 3) >= 36


def test_what_light_does_to_all_balls_alike_is_in_the_position():
    """As much as to each ball by itself; more balls do not average it out."""

    def lights(rng):
        for _ in range(60):
            yield rng.normal(scale=0.04, size=(3, 3)) + rng.normal(scale=0.04, size=3)

    assert inside_of(lights, 4) >= 54


def test_balls_may_be_as_far_out_of_round_as_their_radii_may_be_off():
    """Surfaces of 0.15 mm, the same for all cameras, half oval and half three-lobed."""
    rng, cameras, prior = np.random.default_rng(6), ring(), Motion.at_rest(POSE, 0.0)
    errors, stated = [], []
    spheres, unround = _of_known_radii(0.0), _of_known_radii(0.15)
    for _ in range(30):
        surfaces = [_surface(rng, 0.15) for _ in RAVEN.balls]
        seen = [
            see(RAVEN, camera, ball.name, POSE, offset=_bulge_px(camera, ball, surface))
            for camera in cameras.values()
            for ball, surface in zip(RAVEN.balls, surfaces, strict=True)
        ]
        poses = [solve(body, seen, cameras, prior) for body in (spheres, unround)]
        errors.append(poses[0].world_from_body.difference(POSE))
        stated.append([np.diag(pose.covariance) for pose in poses])
    exact = see_all(RAVEN, cameras, POSE)
    hidden = solve(unround, exact, cameras, prior).covariance
    added = hidden - solve(spheres, exact, cameras, prior).covariance
    ratio = np.sqrt(np.diag(added) / np.mean(np.square(errors), axis=0))
    # Opposite cameras see the same outline: what it does to height and rotation cancels.
    assert np.all((ratio > 0.8) & (ratio < 3.5))
    assert np.all((ratio[:2] > 0.8) & (ratio[:2] < 1.25))
    # What residuals show is stated without it, and not stated twice.
    without, again = np.mean(stated, axis=0)
    assert np.all(again < 1.4 * without)
    assert np.all(np.diag(hidden) > 1.25 * np.diag(hidden - added))


def _of_known_radii(tolerance_mm):
    body = replace(RAVEN, radius_tolerance_mm=tolerance_mm)
    return body.with_radii(body.radii, np.zeros((3, 3)))


def _surface(rng, sd_mm):
    """How far (n,) mm a ball stands out along directions (n, 3): harmonics of degrees 2 and 3."""
    poles = rng.normal(size=(2, 40, 3))
    poles /= np.linalg.norm(poles, axis=2, keepdims=True)
    # The mean square of a Legendre polynomial over the sphere is 1 / (2 degree + 1).
    heights = sd_mm * rng.normal(size=(2, 40)) * np.sqrt([[5 / 80], [7 / 80]])

    def stands_out(directions):
        each = zip((2, 3), poles, heights, strict=True)
        return sum(eval_legendre(degree, directions @ at.T) @ high for degree, at, high in each)

    return stands_out


def _bulge_px(camera, ball, surface):
    """How far (n,) px an outline lies outside that of a sphere."""
    center = camera.camera_from_world.apply(POSE.apply(ball.center_mm))
    tangent_mm = np.sqrt(center @ center - ball.radius_mm**2)
    touched = tangent_mm * tangent_cone(center, ball.radius_mm).bearings(ANGLES)
    normals = camera.world_from_camera.rotate((touched - center) / ball.radius_mm)
    return surface(POSE.inverse().rotate(normals)) * camera.intrinsics.focal_px / tangent_mm


def _in_picture(camera, light_world_px, rng=None):
    """A shift (2,) of one outline: a common one along the world's axes, and its own."""
    seen = camera.camera_from_world.rotate(light_world_px)[:2]
    return seen if rng is None else seen + 0.1 * rng.standard_normal(2)


@pytest.mark.parametrize("common_px", [0.05, 0.4])
def test_where_a_fit_starts_moves_it_by_a_thirtieth_of_what_it_claims_at_most(common_px):
    rng, cameras = np.random.default_rng(7), ring()
    seen = [
        see(RAVEN, camera, name, POSE, rng=rng, shift=common_px * rng.standard_normal(2))
        for camera in cameras.values()
        for name in RAVEN.names
    ]
    starts = [POSE.perturb(share * OFF) for share in (0.0, 1.0, -1.0, 2.5)]
    first, *others = (solve(RAVEN, seen, cameras, Motion.at_rest(at, 0.0)) for at in starts)
    sd = np.sqrt(np.diag(first.covariance))
    for other in others:
        assert np.all(np.abs(first.world_from_body.difference(other.world_from_body)) < sd / 30)
        np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), sd, rtol=0.02)


UNCERTAIN = np.diag([0.2**2] * 3 + [0.0005**2] * 3)
"""Of cameras' poses, in mm and rad: about .8 px."""


def _drawn(rng, covariance, stated=None):
    """Cameras that are off by draws from a covariance (6, 6), and state it or something else."""
    off = {
        name: camera.world_from_camera.perturb(rng.multivariate_normal(np.zeros(6), covariance))
        for name, camera in ring().items()
    }
    stated = covariance if stated is None else stated
    return {name: moved(camera, off[name]) for name, camera in ring(pose_covariance=stated).items()}


@pytest.mark.parametrize("own_px", [0.0, 0.1], ids=["exact", "lit"])
def test_uncertain_cameras_widen_the_covariance_by_what_they_do_to_the_pose(own_px):
    """The same balls, read with cameras moved by their covariance."""
    prior, exact = Motion.at_rest(POSE, 0.0), see_all(RAVEN, ring(), POSE)
    assert solve(RAVEN, exact, ring(pose_covariance=UNCERTAIN), prior).position_sd_mm > (
        3 * solve(RAVEN, exact, ring(), prior).position_sd_mm
    )
    rng, errors, covariances = np.random.default_rng(3), [], []
    for _ in range(80):
        seen = [
            see(RAVEN, camera, name, POSE, rng=rng, shift=own_px * rng.standard_normal(2))
            for camera in ring().values()
            for name in RAVEN.names
        ]
        pose = solve(RAVEN, seen, _drawn(rng, UNCERTAIN), prior)
        assert pose.flags == ()
        errors.append(pose.world_from_body.difference(POSE))
        covariances.append(np.diag(pose.covariance))
    ratio = np.sqrt(np.mean(covariances, axis=0) / np.mean(np.square(errors), axis=0))
    # Light may shift each ball alike in all cameras, which it does not do here.
    assert np.all((ratio > 0.9) & (ratio < 2.8))
    assert np.all(ratio[:3] < 1.4)


def test_cameras_that_state_how_far_they_may_be_off_leave_the_rotation_alone():
    """A camera that is off shifts all of its balls alike, which turns nothing."""
    prior, rng = Motion.at_rest(POSE, 0.0), np.random.default_rng(3)
    seen, off = see_all(RAVEN, ring(), POSE), {"stated": [], "unstated": []}
    for _ in range(40):
        cameras = _drawn(rng, UNCERTAIN)
        for known, rig in (
            ("stated", cameras),
            ("unstated", {name: _unstated(camera) for name, camera in cameras.items()}),
        ):
            pose = solve(RAVEN, seen, rig, prior)
            off[known].append(pose.world_from_body.difference(POSE))
    stated, unstated = (np.sqrt(np.mean(np.square(each), axis=0)) for each in off.values())
    assert np.linalg.norm(stated[3:]) < 0.3 * np.linalg.norm(unstated[3:])
    assert np.linalg.norm(stated[:3]) < 0.8 * np.linalg.norm(unstated[:3])


def test_a_camera_that_was_moved_since_counts_for_little_and_is_flagged():
    """Ten and twenty times as far as its calibration says that it may be off."""
    prior = Motion.at_rest(POSE, 0.0)
    seen, cameras = see_all(RAVEN, ring(), POSE), ring(pose_covariance=UNCERTAIN)
    poses = {}
    for degrees in (0.0, 0.3, 0.6):
        turn = cameras["cam1"].world_from_camera.rotate(np.array([0, np.radians(degrees), 0]))
        there = cameras["cam1"].world_from_camera.perturb([0, 0, 0, *turn])
        turned = {**cameras, "cam1": moved(cameras["cam1"], there)}
        poses[degrees] = solve(RAVEN, seen, turned, prior)
    exact, less, more = poses.values()
    assert exact.flags == ()
    for pose in (less, more):
        assert [flag.split(" sits")[0] for flag in pose.flags] == [
            f"{ball} in cam1" for ball in RAVEN.names
        ]
        assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 0.1


def test_uncertain_lenses_widen_the_covariance_by_what_they_do_to_the_pose():
    lens = np.diag([3, 3, 0.6, 0.6, 3e-3, 0.01, 3e-4, 3e-4, 0, 0, 0, 0]) ** 2
    ratio = _stated_over_seen(
        lambda rng: (np.zeros(6), rng.multivariate_normal(np.zeros(12), lens))
    )
    assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_fits_settle_where_cameras_are_uncertain_by_pixels():
    """As far as the position is concerned, the cameras' shifts may take up nearly all of a step."""
    lens = np.diag([3, 3, 2, 2, 3e-3, 0.01, 3e-4, 3e-4, 0.01, 0, 0, 0]) ** 2
    known = np.zeros((18, 18))
    known[6:, 6:] = lens
    for seed in (8, 16, 20, 27):
        rng, still = np.random.default_rng(seed), np.zeros(6)
        seen = [
            see(RAVEN, camera, name, POSE, rng=rng, shift=0.1 * rng.standard_normal(2))
            for camera in ring().values()
            for name in RAVEN.names
        ]
        cameras = {
            name: _off(camera, still, rng.multivariate_normal(np.zeros(12), lens), known, True)
            for name, camera in ring().items()
        }
        pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
        assert "the fit did not settle" not in pose.flags


def test_what_a_turned_camera_and_a_moved_principal_point_undo_is_not_stated():
    focal = ring()["cam0"].intrinsics.focal_px

    def off(rng):
        turn = rng.normal(scale=1e-3, size=2)
        lens = np.zeros(12)
        lens[2:4] = focal * turn + rng.normal(scale=0.05, size=2)
        return np.array([0, 0, 0, -turn[1], turn[0], 0]), lens

    ratio = _stated_over_seen(off)
    assert np.all((ratio > 0.7) & (ratio < 2))
    taken_apart = _stated_over_seen(off, joined=False)
    assert np.all(taken_apart > 2.5)


def _stated_over_seen(draw, joined=True):
    """Stated sd over RMS (3,) of what cameras that are off by `draw` do to the position.

    Rotations react little, mostly by way of the weights. A draw is the pose's error in the
    camera's own axes (6,), and the intrinsics' (12,).
    """
    prior, body = Motion.at_rest(POSE, 0.0), _of_known_radii(0.0)
    seen = see_all(RAVEN, ring(), POSE)
    exact = solve(body, seen, ring(), prior)
    rng = np.random.default_rng(5)
    many = np.array([np.concatenate(draw(rng)) for _ in range(4000)])
    known = many.T @ many / len(many)
    errors, added = [], []
    for _ in range(40):
        cameras = {name: _off(camera, *draw(rng), known, joined) for name, camera in ring().items()}
        stated = solve(body, seen, cameras, prior)
        errors.append(stated.world_from_body.difference(exact.world_from_body)[:3])
        added.append(np.diag(stated.covariance - exact.covariance)[:3])
    return np.sqrt(np.mean(added, axis=0) / np.mean(np.square(errors), axis=0))


def _unstated(camera):
    lens = camera.intrinsics
    return Camera(
        camera.name,
        Intrinsics(lens.size_wh, lens.matrix, lens.distortion),
        camera.world_from_camera,
    )


def _off(camera, pose, lens, known, joined):
    """The camera with errors in pose (6,) and intrinsics (12,), stating their covariance."""
    matrix = camera.intrinsics.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += lens[:4]
    inside, size = camera.intrinsics, camera.intrinsics.size_wh
    lens_off = Intrinsics(size, matrix, inside.distortion + lens[4:], known[6:, 6:])
    turn = np.kron(np.eye(2), camera.world_from_camera.rotation)
    return Camera(
        camera.name,
        lens_off,
        camera.world_from_camera.perturb(turn @ pose),
        turn @ known[:6, :6] @ turn.T,
        None,
        turn @ known[:6, 6:] if joined else None,
    )
