"""Cameras placed by the body they see at once: mirrored poses, wrong sightings, chains of pairs."""

from __future__ import annotations

import numpy as np
import pytest

from measure.calibration.by_body.linking import Instant, link
from measure.calibration.by_body.single_view import View, body_poses
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Body, Camera, Detection

_NOISE_PX, _SIZE_SD = 0.3, 0.01


def motion(count: int = 24) -> list[RigidTransform]:
    """A body waved through 160 x 120 x 100 mm and turned by some 60 deg."""
    t = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = np.column_stack([80 * np.cos(t), 60 * np.sin(2 * t), 50 * np.sin(t + 1)])
    turns = 0.5 * np.column_stack([np.sin(t), np.cos(2 * t), np.sin(3 * t)])
    return [RigidTransform.from_rotvec(w, p) for w, p in zip(turns, places, strict=True)]


def seen_by(
    camera: Camera, body: Body, pose: RigidTransform, balls: tuple[str, ...], rng, time_s=0.0
) -> list[Detection]:
    """What a search would find of some balls."""
    out = []
    for ball, center in zip(body.balls, pose.apply(body.centers), strict=True):
        if ball.name in balls:
            at = camera.project(center[None])[0] + rng.normal(0, _NOISE_PX, 2)
            outline = camera.outline(center, ball.radius_mm)
            radius = np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean()
            radius *= 1 + rng.normal(0, _SIZE_SD)
            out.append(Detection(ball.name, camera.name, time_s, at, radius, 0.05 * np.eye(2)))
    return out


def recorded(
    rig: tuple[Camera, ...],
    body: Body,
    balls: dict[str, tuple[str, ...]] | None = None,
    count: int = 24,
) -> list[Instant]:
    """What each camera sees of its balls, all of them if none are named."""
    rng = np.random.default_rng(2)
    out = []
    for number, pose in enumerate(motion(count)):
        seen = {
            c.name: seen_by(c, body, pose, (balls or {}).get(c.name, body.names), rng, number / 10)
            for c in rig
        }
        out.append(Instant(number / 10, seen))
    return out


def off(found: tuple[Camera, ...], rig: tuple[Camera, ...]) -> tuple[float, float]:
    """How far the worst camera is from where it should be, mm and deg, seen from the first."""
    world = rig[0].camera_from_world
    apart = [
        (world @ true.world_from_camera).inverse() @ camera.world_from_camera
        for camera, true in zip(found, rig, strict=True)
    ]
    return (
        float(max(np.linalg.norm(one.translation) for one in apart)),
        float(np.degrees(max(np.linalg.norm(one.rotvec) for one in apart))),
    )


def lenses(rig):
    return {camera.name: camera.intrinsics for camera in rig}


def test_a_picture_leaves_the_true_pose_and_its_mirror_image(rig, paper_body):
    rng, both = np.random.default_rng(0), 0
    for pose in motion():
        seen = seen_by(rig[0], paper_body, pose, paper_body.names, rng)
        poses = body_poses(View.of(seen, paper_body, rig[0].intrinsics), paper_body)
        true = (rig[0].camera_from_world @ pose).apply(paper_body.centers)
        apart = [np.linalg.norm(p.apply(paper_body.centers) - true, axis=1).mean() for p in poses]
        assert min(apart) < 4.0
        both += len(poses) > 1
    assert both > 0


def test_cameras_are_placed_where_they_stand(rig, paper_body):
    found = link(lenses(rig), paper_body, recorded(rig, paper_body))
    mm, deg = off(found.cameras, rig)
    assert mm < 12.0
    assert deg < 1.5
    assert len(found.instants) == len(motion())


def test_a_camera_that_never_sees_three_balls_at_once_is_placed(rig, paper_body):
    found = link(
        lenses(rig), paper_body, recorded(rig, paper_body, {rig[1].name: ("green", "red")})
    )
    assert off(found.cameras, rig)[0] < 12.0


def test_distractors_and_wrong_sightings_are_outvoted(rig, paper_body):
    """Three balls of the same colours lie on the table, and one sighting in four is nonsense."""
    rng = np.random.default_rng(3)
    table = RigidTransform.from_rotvec(np.array([0.0, 0.0, 1.0]), np.array([90.0, 80.0, -60.0]))
    lain = paper_body.with_centers(paper_body.centers * [1.6, 1.3, 1.0])
    instants = []
    for instant in recorded(rig, paper_body):
        seen = {}
        for camera in rig:
            own = list(instant.detections[camera.name])
            for k in np.flatnonzero(rng.uniform(size=len(own)) < 0.25):
                d = own[k]
                at = rng.uniform((50, 50), (1200, 650))
                own[k] = Detection(d.ball, d.camera, 0.0, at, d.radius_px, d.covariance_px)
            seen[camera.name] = own + seen_by(camera, lain, table, lain.names, rng)
        instants.append(Instant(instant.time_s, seen))
    assert off(link(lenses(rig), paper_body, instants).cameras, rig)[0] < 15.0


def test_cameras_that_never_see_it_at_once_are_linked_through_others(rig, paper_body):
    """The first sees it only with the second, which sees it with the third, and so on."""
    instants = recorded(rig, paper_body, count=36)
    pairs = [{rig[k].name, rig[k + 1].name} for k in range(3)]
    chained = [
        Instant(one.time_s, {n: s for n, s in one.detections.items() if n in pairs[k // 12]})
        for k, one in enumerate(instants)
    ]
    assert off(link(lenses(rig), paper_body, chained).cameras, rig)[0] < 25.0


def test_a_camera_that_shares_no_instant_is_named(rig, paper_body):
    alone = rig[3].name
    instants = [
        Instant(one.time_s, {n: s for n, s in one.detections.items() if (n == alone) == (k < 12)})
        for k, one in enumerate(recorded(rig, paper_body))
    ]
    with pytest.raises(CalibrationError, match=f"camera {alone}: 0 of its sightings agree"):
        link(lenses(rig), paper_body, instants)


def test_another_body_is_refused(rig, paper_body):
    """The balls lie twice as far apart as the file says."""
    larger = paper_body.with_centers(2 * paper_body.centers)
    with pytest.raises(CalibrationError, match="body file"):
        link(lenses(rig), paper_body, recorded(rig, larger))


def test_linking_says_how_far_it_is(rig, paper_body):
    told = list[tuple[int, int]]()
    link(lenses(rig[:3]), paper_body, recorded(rig[:3], paper_body), lambda *n: told.append(n))
    assert told == [(done, 7) for done in range(1, 8)]
