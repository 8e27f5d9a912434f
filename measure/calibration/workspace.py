"""Where bodies will be measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry import Rays, nearest_point
from measure.model import Camera

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
