"""A second identical body that hides most of the first is never measured without a word."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.measuring import Status
from measure.measuring.association import associate
from measure.measuring.pose_hypotheses import lie_on_body
from tests.hidden_scenes import balls_of, lone_balls, seen, two_bodies
from tests.scenes import RAVEN, TARGET, a_pose, ring
from tests.tracking_rig import run

CAMERAS = ring()


def some_cameras(count):
    return {name: CAMERAS[name] for name in list(CAMERAS)[:count]}


def located(detections, first):
    """How many balls of the first body two cameras see."""
    views = Counter(
        d.ball
        for name, some in detections.items()
        for d in some
        if np.linalg.norm(
            CAMERAS[name].project(first.apply(RAVEN.centers))[RAVEN.index(d.ball)] - d.center_px
        )
        < 8
    )
    return sum(count >= 2 for count in views.values())


def measured_which(found, first, second):
    off = [
        np.max(
            np.linalg.norm(
                found.world_from_body.apply(RAVEN.centers) - pose.apply(RAVEN.centers), axis=1
            )
        )
        for pose in (first, second)
    ]
    return "first" if off[0] < 5 else "second" if off[1] < 5 else "neither"


@pytest.mark.parametrize(("count", "most_blobs"), [(2, 5), (3, 6), (4, 16)])
def test_the_wrong_one_of_two_is_always_flagged(count, most_blobs):
    cameras = some_cameras(count)
    outcomes = Counter()
    for seed in range(120):
        rng = np.random.default_rng([seed, count])
        first, second, blobs = two_bodies(rng, most_blobs)
        detections = seen(cameras, [*balls_of(first), *balls_of(second)], rng, blobs)
        left = located(detections, first)
        found = associate(RAVEN, list(cameras.values()), detections)
        if found.world_from_body is not None:
            which = measured_which(found, first, second)
            outcomes[which, min(left, 1), bool(found.flags)] += 1
    assert outcomes["second", 1, True] >= 5
    assert outcomes["second", 1, False] == 0
    assert not any(which == "neither" for which, _, _ in outcomes)
    # No ball of the first is seen by two cameras: at times nothing tells them apart.
    assert outcomes["second", 0, False] <= 5


@pytest.mark.parametrize("count", [2, 3, 4])
def test_lone_balls_of_the_same_colours_are_no_second_body(count):
    cameras, flags = some_cameras(count), 0
    for seed in range(60):
        rng = np.random.default_rng([seed, count, 1])
        truth = a_pose(rng, 25, 60)
        detections = seen(cameras, [*balls_of(truth), *lone_balls(rng)], rng)
        found = associate(RAVEN, list(cameras.values()), detections)
        assert found.reason == ""
        assert measured_which(found, truth, truth) == "first"
        flags += bool(found.flags)
    assert flags <= 10  # two that are as far apart as in the body, by chance


def test_the_flag_stays_while_the_body_is_tracked():
    first = RigidTransform.from_rotvec([0, 0, 0.2], TARGET + np.array([-30.0, 0, 10]))
    second = RigidTransform.from_rotvec([0.1, 0.2, 1.2], TARGET + np.array([60.0, 30, -10]))
    rng = np.random.default_rng(0)
    dark = {"red": CAMERAS, "green": ("cam0", "cam1"), "yellow": ("cam2", "cam3")}

    def hide(detection):
        pixel = CAMERAS[detection.camera].project(first.apply(RAVEN.centers))
        own = np.linalg.norm(pixel[RAVEN.index(detection.ball)] - detection.center_px) < 20
        return own and detection.camera in dark[detection.ball]

    both = seen(CAMERAS, [*balls_of(first), *balls_of(second)], rng)
    kept = {name: [d for d in some if not hide(d)] for name, some in both.items()}
    found = associate(RAVEN, list(CAMERAS.values()), kept)
    assert measured_which(found, first, second) == "second"
    assert "second body near" in found.flags[0]

    world = lambda t: [(RAVEN, first), (RAVEN, second)]
    measured, _, _ = run(RAVEN, world, CAMERAS, 6, hide_one=hide)
    assert all(m.status is Status.FLAGGED for m in measured)
    assert all(any("second body" in flag for flag in m.pose.flags) for m in measured)


@pytest.mark.parametrize(("gap_s", "flagged"), [(0.1, True), (3.0, False)])
def test_a_body_found_where_it_cannot_have_moved_is_flagged(gap_s, flagged):
    """The first is covered all at once, and only its double beside it is in view."""
    here = RigidTransform(np.eye(3), TARGET)
    there = RigidTransform.from_rotvec([0, 0, 0.5], TARGET + np.array([90.0, 20, 0]))
    world = lambda t: [(RAVEN, here if t < 0.3 else there)]
    hide = lambda ball, camera, t: 0.3 <= t < 0.3 + gap_s
    measured, _, _ = run(RAVEN, world, CAMERAS, 12 + round(gap_s * 30), hide=hide)
    assert measured[5].status is Status.OK
    assert (measured[-1].status is Status.FLAGGED) == flagged
    assert any("further than it can have moved" in f for f in measured[-1].pose.flags) == flagged


@pytest.mark.parametrize(("sd_px", "flagged"), [(0.3, True), (2.0, False)])
def test_two_balls_in_one_camera_are_evidence_if_well_seen(sd_px, flagged):
    """Half-hidden outlines do not tell how far away they are; two of them mean nothing."""
    rng = np.random.default_rng(5)
    first = a_pose(rng, 25, 60)
    offset = 130 * CAMERAS["cam0"].world_from_camera.rotation[:, 0]
    second = RigidTransform(first.rotation, first.translation + offset)
    detections = seen(CAMERAS, balls_of(first), rng)
    name, camera = "cam0", CAMERAS["cam0"]
    others = seen({name: camera}, balls_of(second), np.random.default_rng(0))[name][:2]
    assert len(others) == 2
    exact = [
        replace(
            d,
            center_px=camera.project(second.apply(RAVEN.centers[[RAVEN.index(d.ball)]]))[0],
            covariance_px=sd_px**2 * np.eye(2),
        )
        for d in others
    ]
    found = associate(RAVEN, list(CAMERAS.values()), {**detections, name: detections[name] + exact})
    assert measured_which(found, first, second) == "first"
    assert bool(found.flags) == flagged


def test_candidates_lie_on_the_body_within_its_outlines_only():
    (camera,), pose = ring(1).values(), RigidTransform(np.eye(3), TARGET)
    centers, sideways = pose.apply(RAVEN.centers), camera.world_from_camera.rotation[:, 0]
    radii_off = np.array([0.0, 0.7, 0.9])
    places = centers[1] + RAVEN.radii[1] * radii_off[:, None] * sideways
    pixels = camera.project(np.concatenate([centers[:1], places]))
    own = lie_on_body(pose, RAVEN, [camera], np.zeros(4, np.int64), pixels)
    assert own.tolist() == [True, True, True, False]
