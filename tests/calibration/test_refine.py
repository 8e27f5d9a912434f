from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from measure.arrays import Floats
from measure.calibration import RefineSettings, body_cost, paper_body, refine_rig
from measure.calibration.motion import Recording, Track
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera
from tests.calibration.rigs import cameras

BODY = paper_body()
PRIOR = np.repeat([0.4, np.deg2rad(0.06)], 3)


def motion(times_s: Floats) -> RigidTransform:
    """A smooth wander through the workspace."""
    rates = np.array([1.1, 1.7, 1.4, 0.9, 1.3, 1.9])
    wave = np.sin(rates * times_s[:, None] + np.arange(6)) * [50, 50, 30, 0.6, 0.6, 0.6]
    return RigidTransform.from_rotvec(wave[:, 3:], wave[:, :3] + [0, 0, 250])


@dataclass(frozen=True, eq=False)
class Case:
    true: tuple[Camera, ...]
    start: tuple[Camera, ...]
    recording: Recording
    poses: list[RigidTransform]


def case(
    seed: int, frames: int = 60, noise_px: float = 0.1, late_s: float = 0.0, grown_mm: float = 0.0
) -> Case:
    """Asynchronous cameras off by about their prior; camera i's stamps are i * late_s too early."""
    rng = np.random.default_rng(seed)
    true, times = cameras(), np.arange(frames) / 30
    centers = BODY.centers * (1 + grown_mm / 38)
    tracks, start = {}, []
    for number, camera in enumerate(true):
        lead = rng.uniform(-0.015, 0.015)
        poses = motion(times + lead + number * late_s)
        points = np.einsum("fij,kj->fki", poses.rotation, centers) + poses.translation[:, None]
        pixels = camera.project(points.reshape(-1, 3))
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
        tracks[camera.name] = Track(
            np.repeat(np.arange(frames), 3),
            np.tile(np.arange(3), frames),
            pixels,
            np.tile(np.eye(2) * noise_px**2, (3 * frames, 1, 1)),
            np.full(3 * frames, lead),
        )
        slipped = camera.world_from_camera.perturb(rng.normal(0, PRIOR))
        start.append(replace(camera, world_from_camera=slipped, pose_covariance=np.diag(PRIOR**2)))
    rough = motion(times).perturb(rng.normal(0, np.repeat([0.3, 0.003], 3), (frames, 6)))
    at = motion(times)
    chosen = [at[i] for i in range(0, frames, 6)]
    return Case(true, tuple(start), Recording(times, rough, tracks), chosen)


def errors(found: tuple[Camera, ...], given: Case) -> tuple[float, float]:
    """Body position error RMS in mm: in the world, and after taking out its mean."""
    shifts, _ = body_cost(found, given.true, BODY, given.poses)
    relative = shifts - shifts.mean(axis=0)
    return (
        float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(relative**2, axis=1)))),
    )


def test_relative_error_is_halved_and_the_world_kept() -> None:
    before, after = [], []
    for seed in range(5):
        given = case(seed, frames=40)
        found = refine_rig(given.start, BODY, given.recording)
        before.append(errors(given.start, given))
        after.append(errors(found.cameras, given))
        assert found.noise_factor == pytest.approx(1, abs=0.1)
    world, relative = np.mean(after, axis=0) / np.mean(before, axis=0)
    assert world < 1
    assert relative < 0.5


def test_reported_covariances_hold() -> None:
    squares = []
    for seed in range(8):
        given = case(seed, frames=30)
        for camera, true in zip(
            refine_rig(given.start, BODY, given.recording).cameras, given.true, strict=True
        ):
            error = true.world_from_camera.difference(camera.world_from_camera)
            assert camera.pose_covariance is not None
            squares.append(error @ np.linalg.solve(camera.pose_covariance, error) / 6)
    assert 0.6 < np.mean(squares) < 1.5


def test_clocks_that_are_off_are_found() -> None:
    given = case(1, late_s=0.004)
    found = refine_rig(given.start, BODY, given.recording)
    offsets = np.array([found.clock_offsets_s[f"cam{i}"] for i in range(4)])
    sds = np.array([found.clock_sds_s[f"cam{i}"] for i in range(4)])
    np.testing.assert_allclose(offsets, 0.004 * np.arange(4), atol=0.0004)
    assert np.all(np.abs(offsets - 0.004 * np.arange(4))[1:] < 5 * sds[1:])


def test_the_bodys_own_geometry_is_learnt_against_its_prior() -> None:
    given = case(2, grown_mm=0.3)
    trusting = refine_rig(given.start, BODY, given.recording, RefineSettings(body_tolerance_mm=0))
    learning = refine_rig(given.start, BODY, given.recording, RefineSettings(body_tolerance_mm=0.5))
    np.testing.assert_array_equal(trusting.centers, BODY.centers)
    across = np.linalg.norm(learning.centers[0] - learning.centers[2])
    assert across > np.linalg.norm(BODY.centers[0] - BODY.centers[2]) + 0.1
    assert np.all(learning.center_sds > 0)


def test_repeats_to_the_last_digit() -> None:
    given = case(3, frames=20)
    first, second = (refine_rig(given.start, BODY, given.recording).cameras for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.world_from_camera.matrix, b.world_from_camera.matrix)


def test_wrong_detections_do_not_bend_the_rig() -> None:
    given = case(4)
    tracks = dict(given.recording.tracks)
    pixels = tracks["cam1"].pixels.copy()
    pixels[::15] += 30.0
    tracks["cam1"] = replace(tracks["cam1"], pixels=pixels)
    found = refine_rig(given.start, BODY, replace(given.recording, tracks=tracks))
    assert errors(found.cameras, given)[1] < 0.6 * errors(given.start, given)[1]


def test_a_camera_that_saw_nothing_is_named() -> None:
    given = case(5, frames=20)
    tracks = {name: t for name, t in given.recording.tracks.items() if name != "cam2"}
    with pytest.raises(CalibrationError, match="cam2: saw a ball 0 times"):
        refine_rig(given.start, BODY, replace(given.recording, tracks=tracks))
