from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from measure.geometry import RigidTransform
from measure.measuring import pose_hypotheses
from measure.measuring.association import associate
from measure.model import Ball, BallColor, Body, Detection
from tests.scenes import FOUR, RAVEN, TARGET, a_pose, ring, see

CAMERAS = ring()
SD_PX = 2.0


def by_camera(detections):
    return {name: [d for d in detections if d.camera == name] for name in CAMERAS}


def rough(pose, seed=0, body=RAVEN, cameras=CAMERAS, skip=()):
    return see(cameras, body, pose, SD_PX, np.random.default_rng(seed), skip=skip)


def find(detections, body=RAVEN, cameras=CAMERAS):
    return associate(body, list(cameras.values()), by_camera(detections))


def assert_found(found, truth, mm=3.0, deg=4.0):
    assert found.reason == ""
    error = found.world_from_body.difference(truth)
    assert np.linalg.norm(error[:3]) < mm
    assert np.degrees(np.linalg.norm(error[3:])) < deg


def clutter(seed, count=6):
    """Wrong candidates: blobs of every colour anywhere in each picture."""
    rng = np.random.default_rng(seed)
    return [
        Detection(
            ball.name,
            name,
            0.0,
            rng.uniform([0, 0], [1280, 720]),
            float(rng.uniform(15, 90)),
            SD_PX**2 * np.eye(2),
        )
        for name in CAMERAS
        for ball in RAVEN.balls
        for _ in range(count)
    ]


def spheres(seed, count=3):
    """Distractor balls of the body's colours and size: they agree between cameras."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        pose = RigidTransform(np.eye(3), TARGET + rng.uniform(-90, 90, 3))
        color = rng.integers(3)
        out += [d for d in see(CAMERAS, RAVEN, pose, SD_PX, rng) if d.ball == RAVEN.names[color]]
    return out


@pytest.mark.parametrize("seed", range(6))
def test_finds_the_body_among_clutter_and_distractor_balls(seed):
    truth = a_pose(np.random.default_rng(seed), turn_deg=60)
    right = rough(truth, seed)
    found = find([*clutter(seed), *spheres(seed), *right])
    assert_found(found, truth)
    wrong = [d for d in found.detections if not any(d is r for r in right)]
    assert len(wrong) <= 1  # a blob by chance on top of a ball does no harm
    assert len(found.detections) >= 10


def test_covariance_covers_the_error():
    inside = []
    for seed in range(30):
        truth = a_pose(np.random.default_rng(seed))
        found = find(rough(truth, seed))
        error = found.world_from_body.difference(truth)
        inside.append(error @ np.linalg.solve(found.covariance, error) < 16.8)
    assert np.mean(inside) > 0.9


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=lambda body: body.name)
def test_hidden_balls(body):
    truth = a_pose(np.random.default_rng(4))
    names = body.names
    skip = {(names[0], "cam0"), (names[1], "cam1"), (names[2], "cam2"), (names[0], "cam3")}
    found = associate(body, list(CAMERAS.values()), by_camera(rough(truth, 1, body, skip=skip)))
    assert_found(found, truth)


def test_a_ball_seen_by_one_camera_only():
    truth = a_pose(np.random.default_rng(4))
    skip = {("red", "cam1"), ("red", "cam2"), ("red", "cam3")}
    assert_found(find(rough(truth, 1, skip=skip)), truth, mm=6, deg=8)


@pytest.mark.parametrize("confused", [2, 3, 4])
def test_balls_taken_for_others_are_no_other_body(confused):
    """Some cameras see the green ball as a red one too, and the red as a green: the body turned."""
    truth = a_pose(np.random.default_rng(4))
    right, other = rough(truth, 1), {"green": "red", "red": "green"}
    cameras = list(CAMERAS)[:confused]
    doubles = [
        replace(d, ball=other[d.ball], center_px=d.center_px + 0.4)
        for d in right
        if d.ball in other and d.camera in cameras
    ]
    found = find([*right, *doubles])
    if confused == len(CAMERAS):  # now nobody can tell
        assert found.world_from_body is None
        return
    assert_found(found, truth)
    assert not found.flags


def test_colours_may_repeat():
    same = Body(
        "all red",
        tuple(
            Ball(f"red{i}", BallColor.named("red"), np.array(center), 15.0)
            for i, center in enumerate(
                [(0.0, 0, 0), (60.0, 0, 0), (0.0, 42.0, 0), (10.0, 12.0, 50.0)]
            )
        ),
    )
    truth = a_pose(np.random.default_rng(8), turn_deg=120)
    seen = rough(truth, 2, same)
    candidates = [replace(d, ball=name) for d in seen for name in same.names]
    found = find(candidates, same)
    assert_found(found, truth)
    assert all(
        any(d.center_px is s.center_px and d.ball == s.ball for s in seen) for d in found.detections
    )


def test_an_isosceles_body_of_one_colour_is_ambiguous():
    same = Body("isosceles", tuple(replace(b, color=BallColor.named("red")) for b in RAVEN.balls))
    seen = rough(a_pose(np.random.default_rng(8)), 2, same)
    found = find([replace(d, ball=name) for d in seen for name in same.names], same)
    assert found.world_from_body is None
    assert "two" in found.reason


def test_a_second_identical_body_is_ambiguous():
    first = RigidTransform(np.eye(3), TARGET + np.array([-60.0, 0, 10]))
    second = RigidTransform.from_rotvec([0.1, 0.2, 2.0], TARGET + np.array([70.0, 20, -10]))
    found = find(rough(first, 1) + rough(second, 2))
    assert found.world_from_body is None
    assert found.reason.startswith("two bodies fit equally well, at (")


@pytest.mark.parametrize(
    ("names", "reason"),
    [((), "no ball in view"), (("green",), "too few balls"), (("green", "red"), "too few balls")],
)
def test_too_few_balls(names, reason):
    seen = [d for d in rough(a_pose(np.random.default_rng(1))) if d.ball in names]
    found = find(seen)
    assert found.world_from_body is None
    assert reason in found.reason


def test_one_camera_is_not_enough():
    seen = [d for d in rough(a_pose(np.random.default_rng(1))) if d.camera == "cam0"]
    found = find(seen)
    assert found.world_from_body is None
    assert "no two cameras agree" in found.reason


@pytest.mark.parametrize(("unit", "mm"), [("cm", 10.0), ("inches", 25.4)])
def test_a_body_file_in_another_unit_is_named(unit, mm):
    balls = (
        replace(b, center_mm=b.center_mm / mm, radius_mm=b.radius_mm / mm) for b in RAVEN.balls
    )
    found = find(rough(a_pose(np.random.default_rng(1))), body=replace(RAVEN, balls=tuple(balls)))
    assert found.world_from_body is None
    assert f"all balls are {mm} times as large" in found.reason
    assert found.reason.endswith(f"is it in {unit}?")


def test_triangles_are_put_on_others_by_least_squares():
    rng = np.random.default_rng(3)
    source = rng.normal(0, 50, (3, 3))
    turned = source @ Rotation.random(30, random_state=rng).as_matrix().swapaxes(1, 2)
    target = turned + rng.normal(0, 15, (30, 3, 3)) + TARGET
    found = pose_hypotheses.align_triangles(target, source)
    rotation, translation = found.rotation, found.translation
    middle = target.mean(axis=1)
    best = [
        Rotation.align_vectors(corners - corners.mean(axis=0), source - source.mean(axis=0))[0]
        for corners in target
    ]
    assert rotation == pytest.approx(np.array([r.as_matrix() for r in best]), abs=1e-9)
    assert rotation @ source.mean(axis=0) + translation == pytest.approx(middle, abs=1e-9)
