"""The body's pose from ball centres in pictures: least squares on the reprojection, all at once.

No triangulation: a ball seen by one camera counts. Robust by Tukey's weights (Huber and Ronchetti
2009, section 4.8), so a wrong detection loses its say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.measuring.fit_kernels import fit_rows
from measure.model import Body, Camera, Detection, Rig
from measure.model.camera import MIN_DEPTH_MM
from measure.model.observations import stacked_detections
from measure.records import record

_STEP_TOLERANCE = 1e-8


@record
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
    s = sightings
    try:
        rotation, translation, normal, residuals, distances, weighing = fit_rows(
            s.rig.lenses,
            s.rig.reach,
            s.rig.rotation,
            s.rig.centers,
            s.points_body,
            s.pixels,
            _inverse(s.noise),
            s.lead_s,
            np.zeros(6) if velocity is None else np.ascontiguousarray(velocity),
            np.ascontiguousarray(start.rotation),
            np.ascontiguousarray(start.translation),
            tukey,
            tolerance,
            MIN_DEPTH_MM,
        )
    except np.linalg.LinAlgError:
        raise _undetermined(len(s)) from None
    if weighing < 0:
        raise _undetermined(-weighing - 1)
    distances[np.isnan(distances)] = np.inf
    pose = RigidTransform(rotation, translation)
    return PoseFit(pose, _inverse(normal), residuals, distances)


@lru_cache(maxsize=256)
def _placed(body: Body, names: tuple[str, ...]) -> tuple[Ints, Floats]:
    """Indices (n,) and centres (n, 3) of balls; bodies compare by identity."""
    balls = np.array([body.index(name) for name in names], dtype=np.int64)
    return balls, body.centers[balls]


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _undetermined(count: int) -> DegenerateGeometryError:
    return DegenerateGeometryError(f"{count} ball sightings do not determine a pose")
