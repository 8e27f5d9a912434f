from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from measure.errors import ConfigError
from measure.geometry import RigidTransform, squared_mahalanobis, tangent_cone
from measure.model import Body, Camera, Detection, Intrinsics, Motion
from measure_plugins.pose_solvers.contours import ContoursConfig, ContoursSolver
from tests.scenes import FOUR, RAVEN, ring

POSE = RigidTransform.from_rotvec([0.1, -0.2, 0.3], [5.0, -8.0, 247.0])
OFF = np.array([0.8, -0.6, 0.5, 0.01, -0.012, 0.008])
ANGLES = np.linspace(0, 2 * np.pi, 60, endpoint=False)


def see(body, camera, name, pose, sd=0.05, rng=None, offset=0.0, shift=(0, 0), angles=ANGLES):
    """An exact outline, with noise and an offset along its normals, as a detection."""
    ball = body.balls[body.index(name)]
    center = camera.camera_from_world.apply(pose.apply(ball.center_mm))
    cone = tangent_cone(center, ball.radius_mm)
    points = camera.intrinsics.project(cone.bearings(angles))
    wider = camera.intrinsics.project(
        type(cone)(cone.axis, cone.half_angle + 1e-4).bearings(angles)
    )
    normals = (wider - points) / np.linalg.norm(wider - points, axis=1, keepdims=True)
    along = np.full(len(points), offset)
    if rng is not None:
        along = along + sd * rng.standard_normal(len(points))
    points = points + along[:, None] * normals + np.asarray(shift)
    return Detection(
        name,
        camera.name,
        0.0,
        camera.intrinsics.project(center[None])[0],
        60.0,
        0.01 * np.eye(2),
        outline_px=points,
        outline_sd_px=np.full(len(points), sd),
    )


def see_all(body, cameras, pose, skip=(), **kwargs):
    return [
        see(body, camera, name, pose, **kwargs)
        for camera in cameras.values()
        for name in body.names
        if (camera.name, name) not in skip
    ]


def solve(body, detections, cameras, prior=None, **config):
    return ContoursSolver(ContoursConfig(**config), body).solve([], detections, cameras, 0.0, prior)


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=["raven", "four"])
@pytest.mark.parametrize("offset", [0.0, -0.6])
def test_exact_outlines_give_the_exact_pose(body, offset):
    cameras = ring()
    seen = see_all(body, cameras, POSE, offset=offset)
    pose = solve(body, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    error = pose.world_from_body.difference(POSE)
    assert np.max(np.abs(error[:3])) < 2e-4
    assert np.max(np.abs(error[3:])) < 1e-5
    assert ["outlines lie 0.6 px inside" in flag for flag in pose.flags] == [True] * (offset < 0)


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_radii_that_are_all_wrong_are_flagged(share):
    """The body would seem nearer or further away."""
    cameras = ring()
    wrong = Body("wrong", tuple(replace(b, radius_mm=share * b.radius_mm) for b in RAVEN.balls))
    pose = solve(wrong, see_all(RAVEN, cameras, POSE), cameras, Motion.at_rest(POSE, 0.0))
    side = "outside" if share < 1 else "inside"
    assert any(f"px {side} where the radii in the body file" in flag for flag in pose.flags)


def test_a_detector_without_outlines_is_refused_and_seeing_nothing_is_not():
    """Else `--detector hough` ends without a single pose, and nobody says why."""
    cameras = ring()
    bare = [replace(d, outline_px=None, outline_sd_px=None) for d in see_all(RAVEN, cameras, POSE)]
    with pytest.raises(ConfigError, match="this detector measures none: take another solver"):
        solve(RAVEN, bare, cameras)
    assert solve(RAVEN, [], cameras) is None


def test_starts_without_a_prior_and_from_one_camera():
    cameras = ring()
    seen = see_all(RAVEN, cameras, POSE)
    pose = solve(RAVEN, seen, cameras)
    assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 1e-3
    alone = [d for d in seen if d.camera == "cam1"]
    pose = solve(RAVEN, alone, cameras)
    assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 0.1
    assert any("one camera" in flag for flag in pose.flags)


def test_each_picture_counts_at_its_own_time():
    cameras = ring()
    velocity = np.array([50.0, -30, 20, 0.3, 0.2, -0.4])
    seen = []
    for i, camera in enumerate(cameras.values()):
        time_s = 0.01 * i - 0.015
        moved = Motion(POSE, 0.0, velocity).at(time_s)
        for name in RAVEN.names:
            d = see(RAVEN, camera, name, moved)
            seen.append(type(d)(**{**d.__dict__, "time_s": time_s}))
    prior = Motion(POSE.perturb(OFF), 0.0, velocity)
    error = solve(RAVEN, seen, cameras, prior).world_from_body.difference(POSE)
    assert np.linalg.norm(error[:3]) < 2e-3
    still = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    assert np.linalg.norm(still.world_from_body.difference(POSE)[:3]) > 0.05


def test_a_ball_in_one_camera_counts_and_two_balls_say_how_well():
    cameras = ring()
    only_once = {(c, "red") for c in ("cam1", "cam2", "cam3")}
    seen = see_all(RAVEN, cameras, POSE, skip=only_once)
    prior = Motion.at_rest(POSE.perturb(OFF), 0.0)
    pose = solve(RAVEN, seen, cameras, prior)
    assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 2e-3
    two = [d for d in seen if d.ball != "red"]
    assert solve(RAVEN, two, cameras, prior) is None
    known = np.diag([1.0, 1, 1, 0.01**2, 0.01**2, 0.01**2])
    pose = solve(RAVEN, two, cameras, Motion(prior.world_from_body, 0.0, np.zeros(6), known))
    error = pose.world_from_body.difference(POSE)
    assert any("only 2 balls" in flag for flag in pose.flags)
    # The turn about the line of the two balls stays as uncertain as it was.
    axis = POSE.rotate(RAVEN.centers[0] - RAVEN.centers[1])
    axis /= np.linalg.norm(axis)
    assert 0.008 < np.sqrt(axis @ pose.covariance[3:, 3:] @ axis) < 0.012
    assert squared_mahalanobis(error, pose.covariance) < 17


@pytest.mark.parametrize(("common_px", "least"), [(0.1, 3.0), (0.0, 1.2)])
def test_covariance_holds_the_truth(common_px, least):
    """Outlines shifted one by one, and each ball's by as much in all cameras: by light."""
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


def test_cameras_that_agree_do_not_promise_what_light_does_to_all_of_them():
    """Nothing but noise of 0.01 px tells the cameras apart, and light shifts balls by 0.08 px."""
    cameras, rng = ring(), np.random.default_rng(3)
    inside = 0
    for _ in range(40):
        light = rng.normal(scale=0.08, size=(3, 3))
        seen = [
            see(RAVEN, camera, name, POSE, sd=0.01, rng=rng, shift=_in_picture(camera, shift))
            for camera in cameras.values()
            for name, shift in zip(RAVEN.names, light, strict=True)
        ]
        pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
        off = pose.world_from_body.difference(POSE)[:3]
        inside += squared_mahalanobis(off, pose.covariance[:3, :3]) < 7.81
    assert inside >= 36


def _in_picture(camera, light_world_px, rng=None):
    """A shift (2,) of one outline: a common one along the world's axes, and its own."""
    seen = camera.camera_from_world.rotate(light_world_px)[:2]
    return seen if rng is None else seen + 0.1 * rng.standard_normal(2)


@pytest.mark.parametrize("common_px", [0.05, 0.4])
def test_where_a_fit_starts_moves_it_by_a_fiftieth_of_what_it_claims_at_most(common_px):
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
        assert np.all(np.abs(first.world_from_body.difference(other.world_from_body)) < 0.02 * sd)
        np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), sd, rtol=0.02)


def test_uncertain_cameras_widen_the_covariance():
    known = np.diag([0.2**2] * 3 + [0.0005**2] * 3)
    prior = Motion.at_rest(POSE, 0.0)
    exact = solve(RAVEN, see_all(RAVEN, ring(), POSE), ring(), prior)
    cameras = ring(pose_covariance=known)
    seen = see_all(RAVEN, cameras, POSE)
    assert solve(RAVEN, seen, cameras, prior).position_sd_mm > 3 * exact.position_sd_mm
    # Monte Carlo: the same outlines, read with cameras moved by their covariance.
    rng = np.random.default_rng(3)
    errors, covariances = [], []
    for _ in range(40):
        moved = {
            name: type(camera)(
                camera.name,
                camera.intrinsics,
                camera.world_from_camera.perturb(rng.multivariate_normal(np.zeros(6), known)),
                known,
            )
            for name, camera in cameras.items()
        }
        pose = solve(RAVEN, seen, moved, prior)
        errors.append(pose.world_from_body.difference(POSE))
        covariances.append(np.diag(pose.covariance))
    ratio = np.sqrt(np.mean(covariances, axis=0) / np.mean(np.square(errors), axis=0))
    # Cameras that are off also make the outlines scatter: part of it is counted twice.
    assert np.all((ratio > 0.9) & (ratio < 2.5))


def test_uncertain_lenses_widen_the_covariance_by_what_they_do_to_the_pose():
    lens = np.diag([3, 3, 0.6, 0.6, 3e-3, 0.01, 3e-4, 3e-4, 0, 0, 0, 0]) ** 2
    ratio = _stated_over_seen(
        lambda rng: (np.zeros(6), rng.multivariate_normal(np.zeros(12), lens))
    )
    assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_what_a_turned_camera_and_a_moved_principal_point_undo_is_not_stated():
    focal = ring()["cam0"].intrinsics.focal_px

    def off(rng):
        turn = rng.normal(scale=1e-3, size=2)
        lens = np.zeros(12)
        lens[2:4] = focal * turn + rng.normal(scale=0.05, size=2)
        return np.array([0, 0, 0, -turn[1], turn[0], 0]), lens

    ratio = _stated_over_seen(off)
    assert np.all((ratio > 0.7) & (ratio < 1.4))
    taken_apart = _stated_over_seen(off, joined=False)
    assert np.all(taken_apart > 5)


def _stated_over_seen(draw, joined=True):
    """Stated sd over RMS (3,) of what cameras that are off by `draw` do to the position.

    Rotations react little, mostly by way of the weights. A draw is the pose's error in the
    camera's own axes (6,), and the intrinsics' (12,).
    """
    prior = Motion.at_rest(POSE, 0.0)
    seen = see_all(RAVEN, ring(), POSE)
    exact = solve(RAVEN, seen, ring(), prior)
    rng = np.random.default_rng(5)
    many = np.array([np.concatenate(draw(rng)) for _ in range(4000)])
    known = many.T @ many / len(many)
    errors, added = [], []
    for _ in range(40):
        cameras = {name: _off(camera, *draw(rng), known, joined) for name, camera in ring().items()}
        stated = solve(RAVEN, seen, cameras, prior)
        unstated = solve(RAVEN, seen, {n: _unstated(c) for n, c in cameras.items()}, prior)
        errors.append(stated.world_from_body.difference(exact.world_from_body)[:3])
        added.append(np.diag(stated.covariance - unstated.covariance)[:3])
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


def test_a_wrong_ball_is_flagged_and_does_not_pull():
    cameras = ring()
    rng = np.random.default_rng(2)
    seen = see_all(RAVEN, cameras, POSE, rng=rng, skip={("cam2", "red")})
    seen.append(see(RAVEN, cameras["cam2"], "red", POSE, shift=(9.0, 4.0)))
    pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    assert any("red in cam2" in flag for flag in pose.flags)
    assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 0.05


@pytest.mark.parametrize(("sd_px", "flagged"), [(0.2, True), (1.0, False)])
def test_a_ball_view_is_flagged_where_it_is_off_by_more_than_it_may_be(sd_px, flagged):
    """A mostly hidden ball says itself that it may be two pixels off."""
    cameras = ring()
    seen = see_all(RAVEN, cameras, POSE, rng=np.random.default_rng(2), skip={("cam2", "red")})
    weak = see(RAVEN, cameras["cam2"], "red", POSE, shift=(2.0, 1.0))
    seen.append(replace(weak, covariance_px=sd_px**2 * np.eye(2)))
    pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    assert any("red in cam2" in flag for flag in pose.flags) is flagged


def test_outlines_that_claim_to_be_less_certain_pull_less():
    cameras = ring()
    seen = see_all(RAVEN, cameras, POSE, rng=np.random.default_rng(5))
    shifted = [
        see(RAVEN, cameras["cam0"], d.ball, POSE, shift=(0.3, 0.2)) if d.camera == "cam0" else d
        for d in seen
    ]

    def off(claims):
        claimed = [
            replace(d, covariance_px=0.01 * (claims if d.camera == "cam0" else 1.0) * np.eye(2))
            for d in shifted
        ]
        pose = solve(RAVEN, claimed, cameras, Motion.at_rest(POSE, 0.0))
        return np.linalg.norm(pose.world_from_body.difference(POSE)[:3])

    assert off(4.0) < 0.8 * off(1.0)
    assert off(0.25) > 1.2 * off(1.0)
    assert off(100.0) == off(16.0), "claims count within limits"
    assert np.isfinite(off(0.0))


def test_too_little_is_no_pose():
    cameras = ring()
    assert solve(RAVEN, [], cameras) is None
    few = [see(RAVEN, cameras["cam0"], "red", POSE, angles=ANGLES[:4])]
    assert solve(RAVEN, few, cameras, Motion.at_rest(POSE, 0.0)) is None


@pytest.mark.parametrize("order", list(permutations(range(3))), ids=str)
def test_a_fit_that_runs_away_is_no_pose_and_no_crash(order):
    """Warming up fits circles that no body of this shape explains; some steps end in a ball."""
    balls = [
        replace(ball, center_mm=RAVEN.balls[i].center_mm)
        for ball, i in zip(RAVEN.balls, order, strict=True)
    ]
    ContoursSolver(ContoursConfig(), Body("any", tuple(balls))).warm_up()
