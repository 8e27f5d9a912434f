"""A mirror image of the body is named with its plane, and measuring goes on without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.checking import Level, coverage_findings, search_sample
from measure.geometry import RigidTransform
from measure.measuring import Status
from measure.measuring.association import associate
from tests.scenes import FOUR, RAVEN, TARGET, a_pose, ring, see
from tests.tracking_rig import run

CAMERAS = ring()
RIG = list(CAMERAS.values())
TABLE = np.array([0.0, 0.0, 1.0])


def mirrored(body, pose, normal, below_mm):
    """The body's image in a plane that is so far below it: a body in the world's frame."""
    centers = pose.apply(body.centers)
    heights = (centers - centers.mean(axis=0)) @ normal + below_mm
    return body.with_centers(centers - 2 * heights[:, None] * normal)


def both_seen(body, pose, image, seed=0, cameras=CAMERAS, sd_px=0.3):
    rng = np.random.default_rng(seed)
    own = see(CAMERAS, body, pose, sd_px, rng)
    other = see(cameras, image, RigidTransform.identity(), sd_px, rng)
    return {name: [d for d in (*own, *other) if d.camera == name] for name in CAMERAS}


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=lambda body: body.name)
@pytest.mark.parametrize("below_mm", [60.0, 110.0])
@pytest.mark.parametrize("tilt", [0.0, 0.15])
@pytest.mark.parametrize("count", [2, 4])
def test_the_body_is_told_from_its_image_and_the_plane_is_named(body, below_mm, tilt, count):
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    pose = a_pose(np.random.default_rng(3), 20, 25)
    image = mirrored(body, pose, normal, below_mm)
    some = dict(list(CAMERAS.items())[:count])
    found = associate(body, RIG, both_seen(body, pose, image, cameras=some))
    assert found.world_from_body is not None
    assert not found.flags
    off_mm = found.world_from_body.apply(body.centers) - pose.apply(body.centers)
    assert np.max(np.linalg.norm(off_mm, axis=1)) < 1
    assert found.reflection is not None
    assert found.reflection.normal @ normal > np.cos(np.radians(2))
    assert abs(found.reflection.distance_mm - below_mm) < 1
    assert len(found.reflection.detections) == count * len(body.balls)


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=lambda body: body.name)
def test_an_image_that_is_seen_better_than_the_body_is_not_taken_for_it(body):
    """Of two cameras one sees the body's red ball half hidden, aside and too small."""
    pose = a_pose(np.random.default_rng(3), 20, 25)
    two = dict(list(CAMERAS.items())[:2])
    seen = both_seen(body, pose, mirrored(body, pose, TABLE, 60.0), cameras=two)
    seen = {name: own for name, own in seen.items() if name in two}
    own = seen["cam0"]
    place = next(k for k, d in enumerate(own) if d.ball == body.names[-1])
    hidden = replace(own[place], center_px=own[place].center_px + 25, radius_px=20.0)
    seen["cam0"] = [hidden if d is own[place] else d for d in own]
    found = associate(body, list(two.values()), seen)
    assert found.world_from_body is not None
    assert not found.flags
    assert np.linalg.norm(found.world_from_body.difference(pose)[:3]) < 2
    assert found.reflection.normal @ TABLE > np.cos(np.radians(2))
    assert abs(found.reflection.distance_mm - 60) < 2


def test_two_balls_of_an_image_suffice():
    pose = a_pose(np.random.default_rng(3), 20, 25)
    seen = both_seen(RAVEN, pose, mirrored(RAVEN, pose, TABLE, 80.0))
    kept = {n: [*own[:3], *(d for d in own[3:] if d.ball != "red")] for n, own in seen.items()}
    found = associate(RAVEN, RIG, kept)
    assert found.reflection is not None
    assert abs(found.reflection.distance_mm - 80) < 1
    assert not found.flags


@pytest.mark.parametrize(
    "second",
    [
        RigidTransform.from_rotvec([0.0, 0.0, 0.0], [70.0, 30.0, 0.0]),  # lies beside it
        RigidTransform.from_rotvec([0.0, 0.0, 0.5], [0.0, 0.0, -90.0]),  # turned, below it
        RigidTransform.from_rotvec([0.0, 0.3, 0.0], [0.0, 0.0, -90.0]),
    ],
)
def test_a_real_second_body_is_no_reflection(second):
    pose = RigidTransform(np.eye(3), TARGET)
    centers = pose.apply(second.apply(RAVEN.centers))
    found = associate(RAVEN, RIG, both_seen(RAVEN, pose, RAVEN.with_centers(centers)))
    assert found.world_from_body is None
    assert found.reflection is None
    assert found.reason.startswith("two bodies fit equally well")


def test_nothing_is_mirrored_in_a_plane_that_cameras_see_from_both_sides():
    pose = RigidTransform.from_rotvec([0.0, 1.2, 0.0], TARGET + np.array([45.0, 0.0, 0.0]))
    image = mirrored(RAVEN, pose, np.array([1.0, 0.0, 0.0]), 45.0)
    found = associate(RAVEN, RIG, both_seen(RAVEN, pose, image))
    assert found.world_from_body is None
    assert found.reason.startswith("two bodies fit equally well")


def test_poses_over_a_mirror_are_ok_and_say_what_was_left_out():
    pose = a_pose(np.random.default_rng(3), 20, 25)
    image = mirrored(RAVEN, pose, TABLE, 60.0)
    world = lambda t: [(RAVEN, pose), (image, RigidTransform.identity())]
    measured, _, _ = run(RAVEN, world, CAMERAS, 4)
    for one in measured:
        assert one.status is Status.OK
        assert "a mirror image of the body is in view, in a plane 60 mm from it" in one.reason
        assert np.linalg.norm(one.pose.world_from_body.difference(pose)[:3]) < 0.5
    alone, _, _ = run(RAVEN, lambda t: [(RAVEN, pose)], CAMERAS, 4)
    assert [one.reason for one in alone] == [""] * 4


def test_a_check_notes_the_image_and_leaves_its_balls_out():
    pose = a_pose(np.random.default_rng(3), 20, 25)
    seen = both_seen(RAVEN, pose, mirrored(RAVEN, pose, TABLE, 80.0))
    sample = search_sample(seen, RAVEN, RIG, 0.0)
    finding, *_ = coverage_findings([sample] * 3, RAVEN, RIG)[1]
    assert finding.level is Level.NOTE
    assert "in a plane 80 mm from it with the normal (0, 0, 1)" in finding.text
    left = sample.reflection.left_out_of(seen)
    assert all(left[name] == seen[name][:3] for name in CAMERAS)
    assert {id(d) for d in sample.agreeing} == {id(d) for own in left.values() for d in own}
