"""Poses made up as a rig states them: a truth, and errors drawn from the stated covariance."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.metrology.poses import PoseTable, SharedErrors
from measure.model import Body, Camera, Pose
from measure.results import RunWriter
from tests.results.conftest import BODY, CAMERAS, made_from

STATED = np.diag([0.02, 0.02, 0.03, *[np.deg2rad(0.035)] * 3]) ** 2
"""Of every pose: 0.041 mm and 0.06 deg, 3-D."""
RATE_HZ = 30.0


@dataclass(frozen=True)
class Errors:
    """How errors hang together, as shares of the stated variance; the rest is noise.

    Attributes:
        everywhere: the same in all poses.
        nearby: alike where the balls have moved little.
        scale: by which every translation is longer than it is.
    """

    everywhere: float = 0.0
    nearby: float = 0.0
    scale: float = 1.0


def poses_of(truth: RigidTransform, errors: Errors, rng: np.random.Generator) -> PoseTable:
    """Poses that are off by draws from `STATED`."""
    n, root = len(truth.translation), np.linalg.cholesky(STATED)
    alone = 1.0 - errors.everywhere - errors.nearby
    off = np.sqrt(alone) * rng.normal(size=(n, 6)) + np.sqrt(errors.everywhere) * rng.normal(size=6)
    if errors.nearby:
        # Poses at rest are one place: the correlation of different places only is factored.
        places, which = np.unique(truth.matrix.reshape(n, 16), axis=0, return_inverse=True)
        alike = SharedErrors((), BODY).alike(RigidTransform.from_matrix(places.reshape(-1, 4, 4)))
        draws = np.linalg.cholesky(alike + 1e-9 * np.eye(len(places))) @ rng.normal(
            size=(len(places), 6)
        )
        off = off + np.sqrt(errors.nearby) * draws[which.reshape(-1)]
    scaled = RigidTransform(truth.rotation, errors.scale * truth.translation)
    stated = np.broadcast_to(STATED, (n, 6, 6)).copy()
    return PoseTable(np.arange(n) / RATE_HZ, scaled.perturb(off @ root.T), stated)


def with_rests(places: Floats, rest_s: float = 1.0, move_s: float = 0.4) -> RigidTransform:
    """A body carried from place to place (k, 3) in mm, that stands still at each."""
    still, moving = round(rest_s * RATE_HZ), round(move_s * RATE_HZ)
    path = [np.repeat(places[:1], still, axis=0)]
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, moving) / moving)[:, None]
    for start, end in pairwise(places):
        path += [start + share * (end - start), np.repeat(end[None], still, axis=0)]
    points = np.concatenate(path)
    return RigidTransform(np.broadcast_to(np.eye(3), (len(points), 3, 3)), points)


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
) -> Path:
    """The run folder that holds these poses."""
    with RunWriter(folder, made_from(), body, cameras) as writer:
        for k in range(len(poses)):
            flags = ("in doubt",) if k in flagged else ()
            pose = Pose(
                float(poses.times_s[k]), poses.world_from_body[k], poses.covariances[k],
                0.1, 0.2, tuple(c.name for c in cameras), body.names, flags,
            )  # fmt: skip
            status = Status.FLAGGED if flags else Status.OK
            writer.append(Measurement(k, pose.time_s, {}, (), (), pose, status))
        writer.finish()
    return folder
