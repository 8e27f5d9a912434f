"""Where bodies will be measured, and what wrong cameras cost a body there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import Rays, RigidTransform, nearest_point
from measure.model import Body, Camera, Rig

_GRID = 3


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where bodies will be measured: the box `center` +- `half` (3,) mm."""

    center: Floats
    half: Floats

    def grid(self) -> Floats:
        """Points (27, 3) across the box."""
        steps = np.linspace(-1, 1, _GRID)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return self.center + offsets * self.half


def workspace_of(cameras: tuple[Camera, ...], points: Floats) -> Workspace:
    """The inner half of the marker field (or of the board corners (n, 3) in view).

    Without points: 100 mm around where the cameras' axes meet.

    Raises:
        DegenerateGeometryError: no points, and all cameras look the same way.
    """
    if len(points) >= 4 and np.all(np.ptp(points[:, :2], axis=0) > 0):
        low, high = points.min(axis=0), points.max(axis=0)
        return Workspace((low + high) / 2, np.maximum((high - low) / 4, 10.0))
    axes = Rays(
        np.stack([c.center for c in cameras]),
        np.stack([c.world_from_camera.rotation[:, 2] for c in cameras]),
    )
    return Workspace(nearest_point(axes), np.full(3, 50.0))


def body_cost(
    estimated: tuple[Camera, ...],
    true: tuple[Camera, ...],
    body: Body,
    poses: list[RigidTransform],
) -> tuple[Floats, Floats]:
    """What wrong cameras cost: true ball centres through true cameras, located with estimated ones.

    Args:
        estimated: cameras to judge.
        true: the same cameras as they are, in the same order.
        body: the body.
        poses: its true poses.

    Returns:
        Position errors (n, 3) in mm and rotation errors (n, 3), rotation vectors in rad.
    """
    count = len(body.balls)
    rig = Rig.of([camera for camera in estimated for _ in range(count)])
    rows = len(estimated) * count
    shifts, turns = [], []
    for pose in poses:
        seen = PoseObservations(
            rig,
            np.tile(body.centers, (len(estimated), 1)),
            np.tile(np.arange(count), len(estimated)),
            np.concatenate([camera.project(pose.apply(body.centers)) for camera in true]),
            np.tile(np.eye(2), (rows, 1, 1)),
            np.zeros(rows),
        )
        found = fit_pose(pose, seen, tukey=np.inf, tolerance=1e-10).world_from_body
        delta = found.difference(pose)
        shifts.append(delta[:3])
        turns.append(delta[3:])
    return np.stack(shifts), np.stack(turns)
