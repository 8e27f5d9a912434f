"""Synthetic recordings of a moving body whose cameras, poses and errors are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.errors import body_cost
from measure.arrays import Floats
from measure.calibration.refining.recording import Recording, Track
from measure.geometry import RigidTransform, align_points
from measure.model import Camera, paper_body
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
    seed: int,
    frames: int = 60,
    noise_px: float = 0.1,
    constant_px: float = 0.1,
    grown_mm: float = 0.0,
    slip: Floats = PRIOR,
    stated: bool = True,
    drift_px: float = 0.0,
    true: tuple[Camera, ...] | None = None,
) -> Case:
    """Asynchronous cameras off by `slip`; each ball sits `constant_px` off in each camera.

    With `drift_px`, what it sits off changes along the recording by that much from end to end.
    """
    rng = np.random.default_rng(seed)
    true, times = true or cameras(), np.arange(frames) / 30
    centers = BODY.centers * (1 + grown_mm / 38)
    tracks, start = {}, []
    for camera in true:
        lead = rng.uniform(-0.015, 0.015)
        poses = motion(times + lead)
        points = np.einsum("fij,kj->fki", poses.rotation, centers) + poses.translation[:, None]
        pixels = camera.project(points.reshape(-1, 3)).reshape(frames, 3, 2)
        pixels = pixels + rng.normal(0, constant_px, (3, 2))
        pixels = pixels + np.linspace(-0.5, 0.5, frames)[:, None, None] * rng.normal(
            0, drift_px, (3, 2)
        )
        tracks[camera.name] = Track(
            np.repeat(np.arange(frames), 3),
            np.tile(np.arange(3), frames),
            (pixels + rng.normal(0, noise_px, pixels.shape)).reshape(-1, 2),
            np.tile(np.eye(2) * noise_px**2, (3 * frames, 1, 1)),
            np.full(3 * frames, lead),
        )
        slipped = camera.world_from_camera.perturb(rng.normal(0, slip))
        known = np.diag(slip**2) if stated else None
        start.append(replace(camera, world_from_camera=slipped, pose_covariance=known))
    rough = motion(times).perturb(rng.normal(0, np.repeat([0.3, 0.003], 3), (frames, 6)))
    at = motion(times)
    chosen = [at[i] for i in range(0, frames, 6)]
    return Case(true, tuple(start), Recording(times, rough, tracks), chosen)


def errors(found: tuple[Camera, ...], given: Case) -> tuple[float, float]:
    """Body position error RMS in mm: in the world, and after aligning all poses rigidly."""
    shifts = body_cost(found, given.true, BODY, given.poses)
    true = np.stack([pose.translation for pose in given.poses])
    relative = align_points(true, true + shifts).apply(true + shifts) - true
    return (
        float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(relative**2, axis=1)))),
    )


def camera_errors(found: tuple[Camera, ...], given: Case) -> Floats:
    """Each camera's pose error (c, 6) in its `perturb` chart."""
    return np.stack(
        [
            true.world_from_camera.difference(camera.world_from_camera)
            for true, camera in zip(given.true, found, strict=True)
        ]
    )
