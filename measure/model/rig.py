"""Several cameras stacked, so that one call projects a point into all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.geometry import Rays
from measure.model.camera import Camera


class RigRows(NamedTuple):
    """The arrays of n cameras as compiled code takes them."""

    lenses: Floats  # (n, 16) see `Intrinsics.row`
    reach: Floats  # (n,) ideal radii beyond which the lens models see nothing
    rotation: Floats  # (n, 3, 3) of world_from_camera
    centers: Floats  # (n, 3) projection centres in the world, mm
    covariances: Floats  # (n, 18, 18) of pose and intrinsics (see `Camera`); zero where unknown


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras as arrays, one row per camera; a camera may stand in it more than once."""

    names: tuple[str, ...]  # (n,) of the cameras
    rows: RigRows  # of the cameras, in the same order

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Rig:
        """Stack `cameras`; the same cameras are stacked only once."""
        return _stacked(tuple(cameras))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def uncertain(self) -> bool:
        """Whether anything about the cameras is stated to be uncertain."""
        return bool(np.any(self.rows.covariances))

    @property
    def centers(self) -> Floats:
        """Projection centres (n, 3) in the world, mm."""
        return self.rows.centers

    @property
    def focal_px(self) -> Floats:
        """Mean focal lengths (n,) in px."""
        return (self.rows.lenses[:, 0] + self.rows.lenses[:, 3]) / 2

    def take(self, rows: ArrayLike) -> Rig:
        """The cameras of some `rows`, in that order."""
        index = np.asarray(rows, dtype=np.int64)
        names = tuple(self.names[i] for i in index.tolist())
        return Rig(names, RigRows._make(each[index] for each in self.rows))

    def project(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Project point i into camera i.

        Args:
            points_world: (n, 3) in mm, or one point (3,) for all cameras.

        Returns:
            Pixels (n, 2) and their Jacobians by the world point (n, 2, 3); NaN for
            points without an image.
        """
        from measure.model.rig_kernels import project_rows

        points = np.broadcast_to(points_world, (len(self), 3))
        return project_rows(self.rows, np.ascontiguousarray(points, dtype=np.float64))

    def rays(self, pixels: Floats) -> Rays:
        """World rays of pixel i (n, 2) in camera i; NaN where the lens has no inverse."""
        from measure.model.rig_kernels import ray_rows

        seen = np.ascontiguousarray(pixels, dtype=np.float64)
        return Rays(self.centers, ray_rows(seen, self.rows))


@lru_cache(maxsize=256)
def _stacked(cameras: tuple[Camera, ...]) -> Rig:
    """Cameras compare by identity: what is kept never stands for a camera that was changed."""
    lenses, unknown = [camera.intrinsics for camera in cameras], np.zeros((18, 18))
    known = [unknown if c.covariance is None else c.covariance for c in cameras]
    rows = RigRows(
        np.array([lens.row for lens in lenses]).reshape(-1, 16),
        np.array([lens.reach for lens in lenses], dtype=np.float64),
        np.array([c.world_from_camera.rotation for c in cameras]).reshape(-1, 3, 3),
        np.array([c.center for c in cameras]).reshape(-1, 3),
        np.array(known).reshape(-1, 18, 18),
    )
    return Rig(tuple(camera.name for camera in cameras), rows)
