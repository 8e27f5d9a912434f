"""Several cameras stacked, so that one call projects a point into all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.geometry import Rays
from measure.model.camera import MIN_DEPTH_MM, Camera
from measure.model.distortion import bend, undistort


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras as arrays, one row per camera; a camera may stand in it more than once.

    Attributes:
        names: (n,) of the cameras.
        affine: (n, 2, 2) upper left parts of the camera matrices, px.
        principal: (n, 2) principal points, px.
        distortion: (8, n) coefficients, one column per camera.
        reach: (n,) ideal radii beyond which the lens models fold back.
        rotation: (n, 3, 3) world_from_camera rotations.
        centers: (n, 3) projection centres in the world, mm.
    """

    names: tuple[str, ...]
    affine: Floats
    principal: Floats
    distortion: Floats
    reach: Floats
    rotation: Floats
    centers: Floats

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Rig:
        """Stack `cameras`."""
        matrices = np.stack([camera.intrinsics.matrix for camera in cameras])
        return cls(
            tuple(camera.name for camera in cameras),
            matrices[:, :2, :2],
            matrices[:, :2, 2],
            np.stack([camera.intrinsics.distortion for camera in cameras], axis=1),
            np.array([camera.intrinsics.reach for camera in cameras]),
            np.stack([camera.world_from_camera.rotation for camera in cameras]),
            np.stack([camera.center for camera in cameras]),
        )

    def __len__(self) -> int:
        return len(self.names)

    def take(self, rows: ArrayLike) -> Rig:
        """The cameras of some `rows`, in that order."""
        index = np.asarray(rows, dtype=np.int64)
        return Rig(
            tuple(self.names[i] for i in index),
            self.affine[index],
            self.principal[index],
            self.distortion[:, index],
            self.reach[index],
            self.rotation[index],
            self.centers[index],
        )

    def project(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Project point i into camera i.

        Args:
            points_world: (n, 3) in mm, or one point (3,) for all cameras.

        Returns:
            Pixels (n, 2) and their Jacobians by the world point (n, 2, 3); NaN for
            points without an image.
        """
        from_center = np.broadcast_to(points_world, (len(self), 3)) - self.centers
        p = np.einsum("nji,nj->ni", self.rotation, from_center)
        depth = np.where(p[:, 2] > MIN_DEPTH_MM, p[:, 2], np.nan)
        ideal = p[:, :2] / depth[:, None]
        ideal[np.sum(ideal**2, axis=1) >= self.reach**2] = np.nan
        bent, by_ideal = bend(ideal, self.distortion)
        ideal_by_point = np.zeros((len(self), 2, 3))
        ideal_by_point[:, 0, 0] = ideal_by_point[:, 1, 1] = 1 / depth
        ideal_by_point[:, :, 2] = -ideal / depth[:, None]
        pixels = np.einsum("nij,nj->ni", self.affine, bent) + self.principal
        by_world = self.affine @ by_ideal @ ideal_by_point @ np.swapaxes(self.rotation, 1, 2)
        return pixels, by_world

    def rays(self, pixels: Floats) -> Rays:
        """World rays of pixel i (n, 2) in camera i; NaN where the lens has no inverse."""
        centred = (pixels - self.principal)[:, :, None]
        bent: Floats = (np.linalg.inv(self.affine) @ centred)[:, :, 0]
        ideal = undistort(bent, self.distortion, self.reach)
        bearings = np.column_stack([ideal, np.ones(len(ideal))])
        return Rays(self.centers, np.einsum("nij,nj->ni", self.rotation, bearings))
