"""The body's pose from ball centres in pictures: least squares on the reprojection error.

No triangulation: a ball seen by one camera counts. Tukey's weights (Huber and Ronchetti 2009,
section 4.8) are zero for residuals of more than `tukey` standard deviations. See
docs/explanation/joint_fit.md, formula 21.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.estimation.losses import tukey_weights
from measure.geometry import RigidTransform, chart_jacobian
from measure.limits import MAX_STEPS, SETTLED, SINGULAR
from measure.model import Body, Camera, Detection, Rig
from measure.model.observations import stacked_detections

_FIRST_TUKEY = 1e3
"""Width of Tukey's weights, in standard deviations, in the first two iterations: with a start that
is a little off all residuals are large, and good observations must keep their weights."""


@dataclass(frozen=True, eq=False, slots=True)
class PoseObservations:
    """Pixels of ball centres in pictures, as arrays of n rows."""

    rig: Rig  # the camera of each row
    points_body: Floats  # (n, 3) the ball's centre in the body
    balls: Ints  # (n,) index of the ball
    pixels: Floats  # (n, 2)
    noise: Floats  # (n, 2, 2) covariances of the pixels, px^2
    lead_s: Floats  # (n,) time of the picture after the common instant

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        body: Body,
        cameras: Mapping[str, Camera],
        time_s: float,
        extra_px: float = 0.0,
    ) -> PoseObservations:
        """Stack detections; `extra_px` is added to their standard deviations in quadrature."""
        balls, points_body = _placed(body, tuple([d.ball for d in detections]))
        pixels, noise = stacked_detections(tuple(detections))
        return cls(
            Rig.of([cameras[d.camera] for d in detections]),
            points_body,
            balls,
            pixels,
            noise + extra_px**2 * np.eye(2) if extra_px else noise,
            np.array([d.time_s - time_s for d in detections]),
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def residuals(
        self, world_from_body: RigidTransform, velocity: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Residuals (n, 2), and Jacobians by the pose (n, 2, 6) and by the velocity (n, 2, 6).

        Args:
            world_from_body: the pose at the common instant.
            velocity: (6,) in the pose's `perturb` chart, per second.
        """
        arms = world_from_body.rotate(self.points_body)
        by_pose = chart_jacobian(arms)
        moved = self.lead_s[:, None] * (by_pose @ velocity)
        pixels, by_point = self.rig.project(arms + world_from_body.translation + moved)
        jacobian = by_point @ by_pose
        return self.pixels - pixels, jacobian, jacobian * self.lead_s[:, None, None]


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose."""

    world_from_body: RigidTransform  # at the common instant
    covariance: Floats  # (6, 6) in its `perturb` chart
    residuals_px: Floats  # (n, 2)
    # (n,) squared Mahalanobis distances of the residuals, 2 degrees of freedom each.
    distances: Floats


def fit_pose(
    start: RigidTransform,
    observations: PoseObservations,
    velocity: Floats | None = None,
    tukey: float = 6.0,
    tolerance: float = SETTLED,
) -> PoseFit:
    """Refine a pose on n >= 3 observations of balls not on one line, by Gauss-Newton.

    Args:
        start: a pose from which least squares converges.
        velocity: (6,) of the body, to bring pictures of different times together; at rest if None.
        tukey: a residual this many standard deviations off has no weight at all.
        tolerance: stop when a step is smaller than this, in mm and rad.

    Raises:
        DegenerateGeometryError: the observations do not determine a pose.
    """
    s, pose = observations, start
    turning = np.zeros(6) if velocity is None else velocity
    inverse, normal = np.asarray(np.linalg.inv(s.noise), np.float64), np.eye(6)
    for step in range(MAX_STEPS):
        residuals, slopes, distances = _residuals(s, pose, turning, inverse)
        width = tukey if step > 1 else _FIRST_TUKEY
        weights = tukey_weights(distances, width)
        weighted = np.swapaxes(slopes, 1, 2) @ (inverse * weights[:, None, None])
        normal = (weighted @ slopes).sum(axis=0)
        if step == 0 and not _determined(normal):
            raise _undetermined(int(np.count_nonzero(weights)))
        try:
            change = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, residuals))
        except np.linalg.LinAlgError:
            raise _undetermined(len(s)) from None
        pose = pose.perturb(change)
        if step > 2 and np.max(np.abs(change)) < tolerance:
            break
    if not _determined(normal):
        raise _undetermined(int(np.count_nonzero(weights)))
    residuals, _, distances = _residuals(s, pose, turning, inverse)
    residuals[np.isinf(distances)] = np.nan
    covariance = np.asarray(np.linalg.inv(normal), np.float64)
    return PoseFit(pose, covariance, residuals, distances)


def _residuals(
    seen: PoseObservations, pose: RigidTransform, velocity: Floats, inverse: Floats
) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 2), their slopes (n, 2, 6) and squared Mahalanobis distances (n,).

    Points without an image have zeros, and infinite distances.
    """
    residuals, slopes, _ = seen.residuals(pose, velocity)
    unseen = np.isnan(residuals).any(axis=1)
    residuals, slopes = np.nan_to_num(residuals), np.nan_to_num(slopes)
    distances = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
    distances[unseen] = np.inf
    return residuals, slopes, distances


def _determined(normal: Floats) -> bool:
    """Whether an information matrix, mm and rad scaled to each other, is not singular."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
    spread = np.linalg.eigvalsh(normal * scale[:, None] * scale)
    return bool(spread[0] > SINGULAR * spread[5])


@lru_cache(maxsize=256)
def _placed(body: Body, names: tuple[str, ...]) -> tuple[Ints, Floats]:
    """Indices (n,) and centres (n, 3) of balls; bodies compare by identity."""
    balls = np.array([body.index(name) for name in names], dtype=np.int64)
    return balls, body.centers[balls]


def _undetermined(count: int) -> DegenerateGeometryError:
    return DegenerateGeometryError(f"{count} ball sightings do not determine a pose")
