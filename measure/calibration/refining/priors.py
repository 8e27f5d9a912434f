"""What the first calibration says about the cameras.

Where it holds the covariance of all cameras together, that is the prior. Where it does not, how far
it is off is learnt from the recording (`scatter`): by how many pixels it misses in the workspace,
and by how many mm its cameras stand elsewhere. The two differ, because a camera that stands a
little elsewhere and looks a little aside sees nearly the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.lens import intrinsics_vector
from measure.calibration.refining.scatter import Scatter, learnt_variance
from measure.model import Camera

_ACROSS = 4
"""Points a side of the grid at which misses are counted."""


class CameraPrior(ABC):
    """A normal distribution of the cameras about the first calibration."""

    def __init__(self, first: tuple[Camera, ...]) -> None:
        self.first = first

    @abstractmethod
    def root(self, scatter: Scatter) -> Floats:
        """R (m, p) with R^T R the inverse covariance of all poses and free lens parameters."""

    @abstractmethod
    def covariance_at(self, scatter: Scatter) -> Floats:
        """The covariance (p, p) itself."""

    def change(self, cameras: tuple[Camera, ...], free: tuple[Ints, ...]) -> Floats:
        """How far cameras are from the first ones (p,), camera after camera: pose, then lens."""
        parts = []
        for first, now, own in zip(self.first, cameras, free, strict=True):
            parts.append(now.world_from_camera.difference(first.world_from_camera))
            lens = intrinsics_vector(now.intrinsics) - intrinsics_vector(first.intrinsics)
            parts.append(lens[own])
        return np.concatenate(parts)


class JointPrior(CameraPrior):
    """The covariance of all cameras together, as the first calibration states it."""

    def __init__(self, first: tuple[Camera, ...], covariance: Floats) -> None:
        super().__init__(first)
        self.covariance = covariance
        self._root = root_information(covariance)

    def root(self, scatter: Scatter) -> Floats:
        """See `CameraPrior`; the scatter plays no part."""
        del scatter
        return self._root

    def covariance_at(self, scatter: Scatter) -> Floats:
        """See `CameraPrior`; the scatter plays no part."""
        del scatter
        return self.covariance


class LearntPrior(CameraPrior):
    """How far the cameras are off, by kind of error; how much of each is learnt.

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
        self._implied = _implied_precision(self.stated, self.image)

    def information(self, scatter: Scatter) -> Floats:
        """Inverse covariance (p, p)."""
        return np.asarray(
            self.position / scatter.position_mm**2 + self.image / scatter.image_px**2 + self.stated
        )

    def root(self, scatter: Scatter) -> Floats:
        """See `CameraPrior`."""
        information = self.information(scatter)
        scale = np.sqrt(np.diag(information))
        return np.asarray(np.linalg.cholesky(information / scale[:, None] / scale).T * scale)

    def covariance_at(self, scatter: Scatter) -> Floats:
        """See `CameraPrior`."""
        information = self.information(scatter)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale

    def learn(
        self,
        scatter: Scatter,
        change: Floats,
        posterior: Floats,
        image_px: float,
        position_mm: float,
        count: float,
    ) -> Scatter:
        """How far the cameras are off, from how far they went.

        Args:
            scatter: as believed so far.
            change: (p,) of the cameras.
            posterior: (p, p) their covariance.
            image_px: usual, as
            position_mm: is this, and
            count: for how many observations that counts.
        """
        prior = self.covariance_at(scatter)

        def learnt(kind: Floats, now: float, usual: float) -> float:
            determined = float(np.sum(kind * (prior - posterior))) / now**2
            squares = float(change @ kind @ change)
            return float(np.sqrt(learnt_variance(squares, determined, usual**2, count)))

        return replace(
            scatter,
            image_px=learnt(self.image, scatter.image_px, image_px),
            position_mm=learnt(self.position, scatter.position_mm, position_mm),
        )


def _implied_precision(stated: Floats, image: Floats) -> float:
    """Inverse variance, px^-2, of the misses that stated covariances amount to; 0 if none is."""
    known = np.flatnonzero(np.diag(stated) > 0)
    if len(known) < len(stated):
        return 0.0
    variance = np.trace(image @ np.linalg.inv(stated)) / np.linalg.matrix_rank(image)
    return float(1 / variance)


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
    sides = np.linspace(low, high, _ACROSS).T
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def _information(covariance: Floats) -> Floats:
    root = root_information(covariance)
    return np.asarray(root.T @ root)


def root_information(covariance: Floats) -> Floats:
    """R with R^T R the inverse of a covariance."""
    scale = 1 / np.sqrt(np.diag(covariance))
    correlation = covariance * scale[:, None] * scale
    return np.linalg.inv(np.linalg.cholesky(correlation + 1e-12 * np.eye(len(scale)))) * scale
