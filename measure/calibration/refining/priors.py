"""Prior distribution of the cameras: what the first calibration states about them.

Its joint covariance where it holds one. Else two variances are estimated with the recording
(`noise_model`): of the misses in the workspace, px, and of the camera positions, mm. They differ,
because a camera that stands elsewhere and is turned accordingly has nearly the same image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.least_squares import root_information
from measure.calibration.lens import lens_change
from measure.calibration.refining.noise_model import NoiseModel, shrunken_variance
from measure.model import Camera

_JITTER = 1e-12  # Keeps covariances of rank one less than their size invertible
USUAL_POSITION_MM = 0.5
"""Where cameras usually stand elsewhere than a calibration without a joint covariance says, by
axis (a standard deviation)."""
_USUAL_IMAGE_PX = 0.1  # By how much such a calibration usually misses
_POINTS_PER_SIDE = 4  # Points a side of the grid at which misses are counted


class CameraPrior:
    """A normal distribution of the cameras about the first calibration.

    Attributes:
        joint: the covariance of all cameras together as the first calibration states it, or None:
            then the errors are of several kinds, and the variance of each kind is estimated.
        position: (p, p) with change @ position @ change the squared displacements, mm^2, of
            cameras of which nothing is stated.
        image: (p, p) the same of the misses in the workspace, px^2, as if three points were seen.
        stated: (p, p) information about each camera's pose, and about each lens, by itself.
    """

    def __init__(
        self,
        first: tuple[Camera, ...],
        free: tuple[Ints, ...],
        points_world: Floats,
        joint: Floats | None = None,
    ) -> None:
        size = sum(6 + len(own) for own in free)
        self.first = first
        self.joint = joint if joint is not None and joint.shape == (size, size) else None
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

    def change(self, cameras: tuple[Camera, ...], free: tuple[Ints, ...]) -> Floats:
        """How far cameras are from the first ones (p,), camera after camera: pose, then lens."""
        parts = []
        for first, now, own in zip(self.first, cameras, free, strict=True):
            parts.append(now.world_from_camera.difference(first.world_from_camera))
            parts.append(lens_change(first, now)[own])
        return np.concatenate(parts)

    def root(self, noise: NoiseModel) -> Floats:
        """R (p, p) with R^T R the inverse covariance of all poses and free lens parameters."""
        if self.joint is not None:
            return root_information(self.joint, _JITTER)
        information = self._information(noise)
        scale = np.sqrt(np.diag(information))
        return np.asarray(np.linalg.cholesky(information / scale[:, None] / scale).T * scale)

    def covariance_at(self, noise: NoiseModel) -> Floats:
        """The covariance (p, p) itself."""
        if self.joint is not None:
            return self.joint
        information = self._information(noise)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale

    def _information(self, noise: NoiseModel) -> Floats:
        return np.asarray(
            self.position / noise.position_mm**2 + self.image / noise.image_px**2 + self.stated
        )

    def estimate(self, noise: NoiseModel, change: Floats, posterior: Floats) -> NoiseModel:
        """The noise model with the variances of the cameras' errors, from their change.

        Of a joint covariance none is unknown.

        Args:
            change: (p,) of the cameras.
            posterior: (p, p) their covariance.
        """
        if self.joint is not None:
            return noise
        prior = self.covariance_at(noise)

        def estimated(kind: Floats, now: float, usual: float) -> float:
            determined = float(np.sum(kind * (prior - posterior))) / now**2
            squares = float(change @ kind @ change)
            return float(np.sqrt(shrunken_variance(squares, determined, usual**2)))

        return replace(
            noise,
            image_px=estimated(self.image, noise.image_px, _USUAL_IMAGE_PX),
            position_mm=estimated(self.position, noise.position_mm, USUAL_POSITION_MM),
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
