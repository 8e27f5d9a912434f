from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from measure.errors import ConfigError
from measure.geometry import squared_mahalanobis
from measure.model import Body, Motion
from measure_plugins.pose_solvers.contours import ContoursConfig, ContoursSolver
from tests.plugins.pose_solvers.outlined import OFF, POSE, see, see_all, solve
from tests.scenes import FOUR, RAVEN, ring


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=["raven", "four"])
@pytest.mark.parametrize("offset", [0.0, -0.6])
def test_exact_outlines_give_the_exact_pose(body, offset):
    cameras = ring()
    seen = see_all(body, cameras, POSE, offset=offset)
    pose = solve(body, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    error = pose.world_from_body.difference(POSE)
    assert np.max(np.abs(error / np.repeat([2e-4, 1e-5], 3))) < 1
    assert ["outlines lie 0.6 px inside" in flag for flag in pose.flags] == [True] * (offset < 0)


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_radii_that_are_all_wrong_are_flagged(share):
    """The body would seem nearer or further away."""
    cameras = ring()
    wrong = Body("wrong", tuple(replace(b, radius_mm=share * b.radius_mm) for b in RAVEN.balls))
    pose = solve(wrong, see_all(RAVEN, cameras, POSE), cameras, Motion.at_rest(POSE, 0.0))
    side = "outside" if share < 1 else "inside"
    assert any(f"px {side} where the radii in the body file" in flag for flag in pose.flags)


@pytest.mark.parametrize(("offsets", "flagged"), [((1.0, -0.2), False), ((1.0, 0.7), True)])
def test_outlines_are_only_larger_where_most_cameras_agree(offsets, flagged):
    cameras, seen = ring(len(offsets)), []
    for (name, camera), offset in zip(cameras.items(), offsets, strict=True):
        seen += see_all(RAVEN, {name: camera}, POSE, offset=offset)
    pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE, 0.0))
    assert any("px outside where the radii" in flag for flag in pose.flags) == flagged


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
    pose = solve(RAVEN, [d for d in seen if d.camera == "cam1"], cameras)
    assert np.linalg.norm(pose.world_from_body.difference(POSE)[:3]) < 0.1
    assert any("one camera" in flag for flag in pose.flags)


def test_each_picture_counts_at_its_own_time():
    cameras = ring()
    velocity = np.array([50.0, -30, 20, 0.3, 0.2, -0.4])
    seen = []
    for i, camera in enumerate(cameras.values()):
        time_s = 0.01 * i - 0.015
        moved = Motion(POSE, 0.0, velocity).at(time_s)
        seen += [replace(see(RAVEN, camera, n, moved), time_s=time_s) for n in RAVEN.names]
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


@pytest.mark.parametrize("wrong", [{("cam2", "red")}, {("cam2", "red"), ("cam0", "yellow")}])
def test_a_wrong_ball_does_not_pull_and_is_flagged_unless_all_others_agree(wrong):
    cameras = ring()
    seen = see_all(RAVEN, cameras, POSE, rng=np.random.default_rng(2), skip=wrong)
    for camera, ball in wrong:
        seen.append(see(RAVEN, cameras[camera], ball, POSE, shift=(9.0, 4.0)))
    pose = solve(RAVEN, seen, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    flagged = {f"{b} in {c}" for c, b in wrong if any(f"{b} in {c}" in f for f in pose.flags)}
    assert flagged == ({f"{b} in {c}" for c, b in wrong} if len(wrong) > 1 else set())
    error = pose.world_from_body.difference(POSE)
    assert np.linalg.norm(error[:3]) < 0.05
    assert squared_mahalanobis(error, pose.covariance) < 17


def test_a_ball_view_off_beside_others_that_are_off_half_as_far_is_flagged():
    """So a camera that points beside its place is: the ball that it shows nearest, most of all."""
    cameras = ring()
    seen = see_all(RAVEN, cameras, POSE, rng=np.random.default_rng(2), skip={("cam2", "red")})
    beside = [
        see(RAVEN, cameras["cam2"], d.ball, POSE, shift=(1.4, 0.7)) if d.camera == "cam2" else d
        for d in seen
    ]
    beside.append(see(RAVEN, cameras["cam2"], "red", POSE, shift=(2.4, 1.2)))
    pose = solve(RAVEN, beside, cameras, Motion.at_rest(POSE.perturb(OFF), 0.0))
    assert any("red in cam2" in flag for flag in pose.flags)


@pytest.mark.parametrize(("sd_px", "flagged"), [(0.2, True), (1.0, False)])
def test_ball_views_are_flagged_where_they_are_off_by_more_than_they_may_be(sd_px, flagged):
    """A mostly hidden ball says itself that it may be two pixels off."""
    cameras, hidden = ring(), {("cam2", "red"), ("cam0", "yellow")}
    seen = see_all(RAVEN, cameras, POSE, rng=np.random.default_rng(2), skip=hidden)
    for camera, ball in hidden:
        weak = see(RAVEN, cameras[camera], ball, POSE, shift=(2.0, 1.0))
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


@pytest.mark.parametrize("order", list(permutations(range(3))), ids=str)
def test_a_fit_that_runs_away_is_no_pose_and_no_crash(order):
    """Warming up fits circles that no body of this shape explains; some steps end in a ball."""
    balls = [
        replace(ball, center_mm=RAVEN.balls[i].center_mm)
        for ball, i in zip(RAVEN.balls, order, strict=True)
    ]
    ContoursSolver(ContoursConfig(), Body("any", tuple(balls))).warm_up()
