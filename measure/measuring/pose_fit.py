"""The body's pose from ball centres in pictures: least squares on the reprojection, all at once.

No triangulation: a ball seen by one camera counts. Robust by Tukey's weights (Huber and Ronchetti
2009, section 4.8), so a wrong detection loses its say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.model import Body, Camera, Detection, Rig

_STEPS = 15
_STEP_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class Sightings:
    """Ball centres seen in pictures, as arrays of n rows.

    Attributes:
        rig: the camera of each row.
        points_body: (n, 3) the ball's centre in the body.
        balls: (n,) index of the ball.
        pixels: (n, 2).
        noise: (n, 2, 2) covariances.
        lead_s: (n,) time of the picture after the common instant.
    """

    rig: Rig
    points_body: Floats
    balls: Ints
    pixels: Floats
    noise: Floats
    lead_s: Floats

    @classmethod
    def of(
        cls,
        detections: Sequence[Detection],
        body: Body,
        cameras: Mapping[str, Camera],
        time_s: float,
        extra_px: float = 0.0,
    ) -> Sightings:
        """Stack detections; `extra_px` is added to their standard deviations in quadrature."""
        balls = np.array([body.index(d.ball) for d in detections], dtype=np.int64)
        return cls(
            Rig.of([cameras[d.camera] for d in detections]),
            body.centers[balls],
            balls,
            np.stack([d.center_px for d in detections]),
            np.stack([d.covariance_px for d in detections]) + extra_px**2 * np.eye(2),
            np.array([d.time_s for d in detections]) - time_s,
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
        by_pose = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(self), 3, 3)), -skew(arms)], axis=2
        )
        moved = self.lead_s[:, None] * (by_pose @ velocity)
        pixels, by_point = self.rig.project(arms + world_from_body.translation + moved)
        jacobian = by_point @ by_pose
        return self.pixels - pixels, jacobian, jacobian * self.lead_s[:, None, None]


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose.

    Attributes:
        world_from_body: at the common instant.
        covariance: (6, 6) in its `perturb` chart.
        residuals_px: (n, 2).
        distances: (n,) squared Mahalanobis distances of the residuals, 2 degrees of freedom each.
    """

    world_from_body: RigidTransform
    covariance: Floats
    residuals_px: Floats
    distances: Floats


def fit_pose(
    start: RigidTransform,
    sightings: Sightings,
    velocity: Floats | None = None,
    tukey: float = 6.0,
    tolerance: float = _STEP_TOLERANCE,
) -> PoseFit:
    """Refine a pose on n >= 3 sightings of balls not on one line.

    Args:
        start: a pose from which least squares converges.
        sightings: what was seen.
        velocity: (6,) of the body, to bring pictures of different times together; at rest if None.
        tukey: a residual this many standard deviations off has no weight at all.
        tolerance: stop when a step is smaller than this, in mm and rad.

    Raises:
        DegenerateGeometryError: the sightings do not determine a pose.
    """
    speed = np.zeros(6) if velocity is None else velocity
    inverse = np.linalg.inv(sightings.noise)
    pose = start
    for step_number in range(_STEPS):
        residuals, jacobian, _ = sightings.residuals(pose, speed)
        seen = np.all(np.isfinite(residuals), axis=1)
        residuals[~seen], jacobian[~seen] = 0.0, 0.0
        distance = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        # The first steps see everything: a start that is a little off must not lose its witnesses.
        width = tukey if step_number > 1 else 1e3
        weight = seen * np.maximum(1 - distance / width**2, 0.0) ** 2
        gain = np.swapaxes(jacobian, 1, 2) @ (inverse * weight[:, None, None])
        normal = (gain @ jacobian).sum(axis=0)
        if step_number == 0:
            _check(normal, weight)
        step = _step(normal, np.einsum("nij,nj->i", gain, residuals), weight)
        pose = pose.perturb(step)
        if step_number > 2 and np.max(np.abs(step)) < tolerance:
            break
    _check(normal, weight)
    residuals, _, _ = sightings.residuals(pose, speed)
    distance = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
    return PoseFit(
        pose, np.linalg.inv(normal), residuals, np.nan_to_num(np.asarray(distance), nan=np.inf)
    )


def _step(normal: Floats, gradient: Floats, weight: Floats) -> Floats:
    try:
        return np.asarray(np.linalg.solve(normal, gradient), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise _undetermined(weight) from None


def _undetermined(weight: Floats) -> DegenerateGeometryError:
    count = int(np.sum(weight > 0))
    return DegenerateGeometryError(f"{count} ball sightings do not determine a pose")


def _check(normal: Floats, weight: Floats) -> None:
    """Raise if the information matrix (mm and rad scaled to each other) is singular."""
    scale = np.sqrt(np.clip(np.diag(normal), 1e-30, None))
    spread = np.linalg.eigvalsh(normal / np.outer(scale, scale))
    if not spread[0] > 1e-9 * spread[-1]:
        raise _undetermined(weight)
