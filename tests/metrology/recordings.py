"""Runs of poses made up as a rig states them: a truth, and errors drawn from what is stated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.acceptance import Errors, poses_with, with_rests
from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.metrology.poses import PoseTable
from measure.model import Body, Camera, Pose
from measure.results import RunWriter
from tests.results.conftest import BODY, CAMERAS, made_from

__all__ = ["Errors", "pivoting", "poses_of", "with_rests", "write_run"]


def poses_of(truth: RigidTransform, errors: Errors, rng: np.random.Generator) -> PoseTable:
    """Poses of the body of these tests, that are off by draws from what they state."""
    return poses_with(truth, errors, BODY, rng)


def pivoting(
    tip_mm: Floats, point_mm: Floats, opening_deg: float, count: int = 120
) -> RigidTransform:
    """A tool that is tilted to all sides about its tip, in a cone, and turned a little."""
    k = np.arange(count) / count
    tilt = np.deg2rad(opening_deg / 2) * np.sqrt(np.abs(np.sin(2 * np.pi * 3.3 * k)))
    side = 2 * np.pi * 7 * k
    turns = np.stack([tilt * np.cos(side), tilt * np.sin(side), 0.3 * np.sin(9 * k)], axis=1)
    rotation = RigidTransform.from_rotvec(turns).rotation
    return RigidTransform(rotation, point_mm - rotation @ tip_mm)


def write_run(
    folder: Path,
    poses: PoseTable,
    body: Body = BODY,
    cameras: tuple[Camera, ...] = CAMERAS,
    flagged: frozenset[int] = frozenset(),
    **made: object,
) -> Path:
    """The run folder that holds these poses."""
    with RunWriter(folder, replace(made_from(), **made), [body], cameras) as writer:
        for k in range(len(poses)):
            flags = ("in doubt",) if k in flagged else ()
            place = poses.world_from_body[k]
            time_s, stated = float(poses.times_s[k]), poses.covariances[k]
            writer.append(measured(k, time_s, place, stated, body.names, flags))
        writer.finish()
    return folder


def measured(
    index: int,
    time_s: float,
    world_from_body: RigidTransform,
    covariance: Floats,
    balls: tuple[str, ...],
    flags: tuple[str, ...] = (),
) -> Measurement:
    """A frame set of which nothing but the pose is known."""
    seen_by = tuple(camera.name for camera in CAMERAS)
    pose = Pose(time_s, world_from_body, covariance, 0.1, 0.2, seen_by, balls, flags)
    status = Status.FLAGGED if flags else Status.OK
    return Measurement(index, time_s, {}, (), (), pose, status)
