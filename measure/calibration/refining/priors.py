"""Prior distribution of the cameras: what the first calibration states about them.

Its joint covariance where it holds one. Else two variances are estimated with the recording
(`noise_model`): of the misses in the workspace, px, and of the camera positions, mm. They differ,
because a camera that stands elsewhere and is turned accordingly has nearly the same image.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.least_squares import root_information
from measure.calibration.lens import lens_change
from measure.calibration.refining.noise_model import NoiseModel, shrunken_variance
from measure.model import Camera

_JITTER = 1e-12  # Keeps covariances of rank one less than their size invertible
_POINTS_PER_SIDE = 4  # Points a side of the grid at which misses are counted


class CameraPrior(ABC):
    """A normal distribution of the cameras about the first calibration."""

    def __init__(self, first: tuple[Camera, ...]) -> None:
        self.first = first

    @abstractmethod
    def root(self, noise: NoiseModel) -> Floats:
        """R (m, p) with R^T R the inverse covariance of all poses and free lens parameters."""

    @abstractmethod
    def covariance_at(self, noise: NoiseModel) -> Floats:
        """The covariance (p, p) itself."""

    def change(self, cameras: tuple[Camera, ...], free: tuple[Ints, ...]) -> Floats:
        """How far cameras are from the first ones (p,), camera after camera: pose, then lens."""
        parts = []
        for first, now, own in zip(self.first, cameras, free, strict=True):
            parts.append(now.world_from_camera.difference(first.world_from_camera))
            parts.append(lens_change(first, now)[own])
        return np.concatenate(parts)


class JointPrior(CameraPrior):
    """The covariance of all cameras together, as the first calibration states it."""

    def __init__(self, first: tuple[Camera, ...], covariance: Floats) -> None:
        super().__init__(first)
        self.covariance = covariance
        self._root = root_information(covariance, _JITTER)

    def root(self, noise: NoiseModel) -> Floats:
        """See `CameraPrior`; the scatter plays no part."""
        del noise
        return self._root

    def covariance_at(self, noise: NoiseModel) -> Floats:
        """See `CameraPrior`; the scatter plays no part."""
        del noise
        return self.covariance


class EstimatedPrior(CameraPrior):
    """Errors of the cameras by kind, the variance of each kind estimated.

    Attributes:
        position: (p, p) with change @ position @ change the squared displacements, mm^2, of
            cameras of which nothing is stated.
        image: (p, p) the same of the misses in the workspace, px^2, as if three points were seen.
        stated: (p, p) information about each camera's pose, and about each lens, by itself.
    """

    def __init__(
        self, first: tuple[Camera, ...], free: tuple[Ints, ...], points_world: Floats
    ) -> None:
        super().__init__(first)
        size = sum(6 + len(own) for own in free)
        self.position, self.image, self.stated = np.zeros((3, size, size))
        row = 0
        for camera, own in zip(first, free, strict=True):
            at = slice(row, row + 6 + len(own))
            self.image[at, at] = _misses(camera, own, points_world)
            pose, lens = camera.pose_covariance, camera.intrinsics.covariance
            turn, way = slice(row, row + 6), slice(row, row + 3)
            if pose is not None and np.all(np.diag(pose) > 0):
                self.stated[turn, turn] = _information(pose)
            else:
                self.position[way, way] = np.eye(3)
            if lens is not None and len(own):
                rest = slice(row + 6, at.stop)
                self.stated[rest, rest] = _information(lens[np.ix_(own, own)])
            row = at.stop

    def information(self, noise: NoiseModel) -> Floats:
        """Inverse covariance (p, p)."""
        return np.asarray(
            self.position / noise.position_mm**2 + self.image / noise.image_px**2 + self.stated
        )

    def root(self, noise: NoiseModel) -> Floats:
        """See `CameraPrior`."""
        information = self.information(noise)
        scale = np.sqrt(np.diag(information))
        return np.asarray(np.linalg.cholesky(information / scale[:, None] / scale).T * scale)

    def covariance_at(self, noise: NoiseModel) -> Floats:
        """See `CameraPrior`."""
        information = self.information(noise)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale

    def estimate(
        self,
        noise: NoiseModel,
        change: Floats,
        posterior: Floats,
        image_px: float,
        position_mm: float,
        count: float,
    ) -> NoiseModel:
        """The noise model with the variances of the cameras' errors, from their change.

        Args:
            change: (p,) of the cameras.
            posterior: (p, p) their covariance.
            image_px: usual standard deviation.
            position_mm: usual standard deviation.
            count: how many observations the usual values are worth.
        """
        prior = self.covariance_at(noise)

        def estimated(kind: Floats, now: float, usual: float) -> float:
            determined = float(np.sum(kind * (prior - posterior))) / now**2
            squares = float(change @ kind @ change)
            return float(np.sqrt(shrunken_variance(squares, determined, usual**2, count)))

        return replace(
            noise,
            image_px=estimated(self.image, noise.image_px, image_px),
            position_mm=estimated(self.position, noise.position_mm, position_mm),
        )


def _misses(camera: Camera, free: Ints, points_world: Floats) -> Floats:
    """Mean squared miss at points, times three: as a matrix on the camera's change."""
    _, _, by_pose, by_lens = camera.project_with_jacobians(points_world)
    J = np.concatenate([by_pose, by_lens[:, :, free]], axis=2)
    J = J[np.all(np.isfinite(J), axis=(1, 2))]
    rows = J.reshape(-1, J.shape[2])
    return np.asarray(3 / max(len(J), 1) * rows.T @ rows)


def workspace_grid(points_world: Floats) -> Floats:
    """A grid (n, 3) through the box that points fill."""
    low, high = points_world.min(axis=0), points_world.max(axis=0)
    sides = np.linspace(low, high, _POINTS_PER_SIDE).T
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def _information(covariance: Floats) -> Floats:
    root = root_information(covariance, _JITTER)
    return np.asarray(root.T @ root)
