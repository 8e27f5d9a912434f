"""Poses of one body, and what their errors have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from measure.arrays import Floats
from measure.estimation.expected_accuracy import pose_by_cameras, tolerance_covariance
from measure.geometry import RigidTransform, propagate
from measure.limits import TINY
from measure.model import Body, Camera

ALIKE_OVER_MM = 20.0
"""Errors that no calibration states (light, paint) correlate by exp(-d / 20 mm) where the balls
have moved by d (docs/explanation/uncertainty.md)."""
_LEAST_ALIKE = 0.1
"""Share of the stated variance that no average shrinks, however much the poses scatter."""
_FOREIGN = 2.0
"""Standard deviation by cameras over the stated one, from which they are not those of the poses: it
is linearised, and up to 1.4 with cameras that are uncertain by 0.2 mm and 0.03 deg."""
_BLOCK = 1000


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of one body that may be relied on, in order of time."""

    times_s: Floats  # (n,)
    world_from_body: RigidTransform  # n poses
    covariances: Floats  # (n, 6, 6) of the poses, in their `perturb` chart

    def __len__(self) -> int:
        return len(self.times_s)

    def take(self, rows: slice | ArrayLike) -> PoseTable:
        """Some of them."""
        which = rows if isinstance(rows, slice) else np.asarray(rows)
        place = self.world_from_body
        poses = RigidTransform(place.rotation[which], place.translation[which])
        return PoseTable(self.times_s[which], poses, self.covariances[which])


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What all poses of a recording err by together.

    The error of a pose is the sum of four: of the calibration (cameras, scale) and of the body
    file, which are the same numbers in all poses and move each as its place and turn have it; of
    light and paint, alike in poses near each other (`alike`); and noise, each pose's own.
    """

    cameras: Sequence[Camera]  # as used, with their covariances
    body: Body  # as used, with its tolerance
    scale_sd: float = 0.0  # of the world; the poses' own covariances are without it

    def factors(self, poses: PoseTable) -> Floats:
        """How n poses (n, 6, k) move by k unknowns of unit variance: of cameras, body and scale.

        The scale is the last; the others are in the poses' covariances.
        Two poses share the covariance `factors[i] @ factors[j].T`. Where that is far more than is
        stated of them, the poses were not measured with these cameras: they share none of it.
        """
        places = poses.world_from_body
        turned = np.zeros((len(poses), 6, 6))
        turned[:, :3, :3] = turned[:, 3:, 3:] = places.rotation
        own = tolerance_covariance(self.body, RigidTransform.identity(), self.body.names)
        by_body = turned @ _root(own)
        roots = [_root(c.covariance) for c in self.cameras if c.covariance is not None]
        parts = []
        for k in range(len(poses) if roots else 0):
            moved = zip(
                self.cameras, pose_by_cameras(self.cameras, self.body, places[k]), strict=True
            )
            by_cameras = [by for camera, by in moved if camera.covariance is not None]
            moves = [J @ F for J, F in zip(by_cameras, roots, strict=True)]
            parts.append(np.concatenate(moves, axis=1))
        whole = np.concatenate([np.array(parts), by_body], axis=2) if parts else by_body
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", poses.covariances), TINY))
        stated = poses.covariances / (scale[:, :, None] * scale[:, None]) + 1e-9 * np.eye(6)
        white = np.linalg.solve(np.linalg.cholesky(stated), whole / scale[:, :, None])
        excess = np.median(np.linalg.norm(white, ord=2, axis=(1, 2))) if len(poses) else 0.0
        known = whole if excess < _FOREIGN else np.zeros_like(whole)
        by_scale = np.zeros((len(poses), 6, 1))
        by_scale[:, :3, 0] = self.scale_sd * places.translation
        return np.concatenate([known, by_scale], axis=2)

    def alike(self, poses: RigidTransform, others: RigidTransform | None = None) -> Floats:
        """Correlation (n, m) of the errors by light of poses with others: with themselves if None.

        By how far the balls have moved, RMS.
        """
        mine = self._places(poses)
        theirs = mine if others is None else self._places(others)
        return np.asarray(np.exp(-cdist(mine, theirs) / ALIKE_OVER_MM))

    def of_sum(self, gains: Floats, poses: PoseTable, scatter: float) -> Floats:
        """Covariance (m, m) of a linear combination, by gains (n, m, 6), of the errors of n poses.

        How far errors by light stay alike differs from room to room, so that they are counted in
        both ways: as `alike` says, and the same throughout. `scatter` is half the mean square by
        which neighbours differ, over the stated variance.
        """
        factors = self.factors(poses)
        known = np.einsum("nma,nak->mk", gains, factors)
        in_stated = factors[:, :, :-1]
        scatter = self._noise_share(scatter, poses.world_from_body)
        light = alike_part(scatter, poses.covariances, in_stated @ np.swapaxes(in_stated, 1, 2))
        by_light = gains @ square_root(light)
        whole, n = by_light.sum(axis=0), len(poses)
        near = np.zeros((gains.shape[1],) * 2)
        for start in range(0, n, _BLOCK):
            rows = slice(start, start + _BLOCK)
            alike = self.alike(poses.world_from_body[rows], poses.world_from_body)
            around = (alike @ by_light.reshape(n, -1)).reshape(-1, *whole.shape)
            near += np.einsum("nma,nka->mk", by_light[rows], around)
        noise = scatter * propagate(gains, poses.covariances).sum(axis=0)
        return np.asarray(known @ known.T + near + whole @ whole.T + noise)

    def _noise_share(self, scatter: float, poses: RigidTransform) -> float:
        """Share of noise in the stated variance by how neighbours differ: that is not all noise."""
        apart = np.linalg.norm(np.diff(self._places(poses), axis=0), axis=1)
        alike = float(np.mean(np.exp(-apart / ALIKE_OVER_MM)))
        return max(1.0 - (1.0 - scatter) / alike, 0.0) if scatter < 1 else scatter

    def _places(self, poses: RigidTransform) -> Floats:
        """The balls (n, 3 k), scaled so that distances are RMS over the balls."""
        turned = np.einsum("nij,kj->nki", poses.rotation, self.body.centers)
        places = turned + poses.translation[:, None]
        return places.reshape(len(places), -1) / np.sqrt(len(self.body.balls))


def unexplained(stated: Floats, known: Floats) -> Floats:
    """What is left (..., 6, 6) of stated covariances without what cameras and body contribute.

    Never negative: `known` is linearised, and along some direction it may be the larger one.
    """
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", stated), TINY))
    outer = scale[..., :, None] * scale[..., None, :]
    values, axes = np.linalg.eigh((stated - known) / outer)
    kept = np.maximum(values, 0.0)
    return np.asarray((axes * kept[..., None, :]) @ np.swapaxes(axes, -1, -2) * outer)


def scatter_share(deviations: Floats, covariance: Floats, spent: float = 1.0) -> Floats:
    """Variance of n deviations, less `spent` ones, over that of covariances, mean of directions."""
    whole = _mean_ratio(np.swapaxes(deviations, -1, -2) @ deviations, covariance)
    return np.asarray(whole / max(deviations.shape[-2] - spent, 1.0))


def alike_part(scatter: float, stated: Floats, known: Floats) -> Floats:
    """The part of stated covariances (..., 6, 6) that light makes.

    By the variance by which neighbours scatter, over the stated one, and what cameras and body are
    known to contribute.
    """
    left = unexplained(stated, known)
    share = float(np.mean(_mean_ratio(left, stated)))
    return max(1.0 - scatter / max(share, TINY), _LEAST_ALIKE) * left


def independent_count(deviations: Floats) -> float:
    """How many independent ones n deviations (n, k) in a row are worth, by their autocorrelation.

    The sum of the autocorrelation ends where pairs of neighbours turn negative (Geyer 1992, Stat.
    Sci. 7, section 3.3).
    """
    n = len(deviations)
    spectrum = np.fft.rfft(deviations, 2 * n, axis=0)
    correlation = np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=1))[: n - n % 2]
    if correlation[0] <= 0:
        return float(n)
    pairs = (correlation / correlation[0]).reshape(-1, 2).sum(axis=1)
    positive = np.cumprod(pairs > 0)
    length = max(2 * float(np.sum(pairs * positive)) - 1, 1.0)
    return max(n / length, 1.0)


def square_root(covariances: Floats) -> Floats:
    """Symmetric roots (..., 6, 6) of covariances, which vary smoothly from pose to pose."""
    values, axes = np.linalg.eigh(covariances)
    kept = np.sqrt(np.maximum(values, 0.0))
    return np.asarray((axes * kept[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _root(covariance: Floats) -> Floats:
    """A factor F with F F^T the covariance, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(scale[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))


def _mean_ratio(part: Floats, whole: Floats) -> Floats:
    """Mean (...) over six directions of one variance over another, (..., 6, 6) each."""
    floor = np.einsum("...ii->...i", whole)[..., None] * 1e-9 * np.eye(6) + TINY * np.eye(6)
    return np.asarray(np.einsum("...ii->...", np.linalg.solve(whole + floor, part)) / 6)
