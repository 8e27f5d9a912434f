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
from measure.compiling import compiled
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.geometry.linear_kernels import squared_distance
from measure.geometry.rotation_kernels import rotation_of
from measure.model import Body, Camera, Detection, Rig
from measure.model.observations import stacked_detections
from measure.model.rig import RigRows
from measure.model.rig_kernels import project_one

_STEP_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False, slots=True)
class PoseObservations:
    """Pixels of ball centres in pictures, as arrays of n rows.

    Attributes:
        rig: the camera of each row.
        points_body: (n, 3) the ball's centre in the body.
        balls: (n,) index of the ball.
        pixels: (n, 2).
        noise: (n, 2, 2) covariances of the pixels, px^2.
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
    observations: PoseObservations,
    velocity: Floats | None = None,
    tukey: float = 6.0,
    tolerance: float = _STEP_TOLERANCE,
) -> PoseFit:
    """Refine a pose on n >= 3 observations of balls not on one line, by Gauss-Newton.

    Args:
        start: a pose from which least squares converges.
        observations: the pixels.
        velocity: (6,) of the body, to bring pictures of different times together; at rest if None.
        tukey: a residual this many standard deviations off has no weight at all.
        tolerance: stop when a step is smaller than this, in mm and rad.

    Raises:
        DegenerateGeometryError: the observations do not determine a pose.
    """
    s = observations
    try:
        rotation, translation, normal, residuals, distances, weighing = fit_pose_rows(
            s.rig.rows,
            s.points_body,
            s.pixels,
            _inverse(s.noise),
            s.lead_s,
            np.zeros(6) if velocity is None else np.ascontiguousarray(velocity),
            np.ascontiguousarray(start.rotation),
            np.ascontiguousarray(start.translation),
            tukey,
            tolerance,
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


_MAX_ITERATIONS = 15
_FIRST_TUKEY = 1e3
"""Width of Tukey's weights, in standard deviations, in the first two iterations: with a start that
is a little off all residuals are large, and good observations must keep their weights."""
_MIN_EIGENVALUE_RATIO = 1e-9
"""Least eigenvalue of the scaled information over the greatest for which there is a pose."""


@compiled
def fit_pose_rows(
    rig: RigRows,
    points_body: Floats,
    pixels: Floats,
    inverse: Floats,
    lead_s: Floats,
    velocity: Floats,
    rotation: Floats,
    translation: Floats,
    tukey: float,
    tolerance: float,
) -> tuple[Floats, Floats, Floats, Floats, Floats, int]:
    """Robust Gauss-Newton on the reprojection of n points of a body.

    Args:
        rig: the n cameras.
        points_body: (n, 3).
        pixels: (n, 2).
        inverse: (n, 2, 2) inverse covariances of the pixels.
        lead_s: (n,) time of the picture after the common instant.
        velocity: (6,) of the body, in the pose's `perturb` chart, per second.
        rotation: (3, 3) of world_from_body to start from.
        translation: (3,) the same.
        tukey: a residual this many standard deviations off has no weight at all.
        tolerance: stop when a step is smaller than this, in mm and rad.

    Returns:
        Rotation (3, 3), translation (3,), information (6, 6), residuals (n, 2) and their squared
        Mahalanobis distances (n,) at the end; the number of points of non-zero weight, or minus
        one minus that number if they do not determine a pose.
    """
    n = len(pixels)
    rotation, translation = rotation.copy(), translation.copy()
    residuals, slopes, distance = np.empty((n, 2)), np.empty((n, 2, 6)), np.empty(n)
    normal, right, change, weighing = np.empty((6, 6)), np.empty(6), np.empty(6), 0
    for step in range(_MAX_ITERATIONS):
        _fill_residuals(
            rig, points_body, pixels, lead_s, velocity, rotation, translation, residuals, slopes
        )
        weighing = _equations(
            residuals, slopes, inverse, tukey if step > 1 else _FIRST_TUKEY, normal, right
        )
        if step == 0 and not _determined(normal):
            return rotation, translation, normal, residuals, distance, -weighing - 1
        change[:] = np.linalg.solve(normal, right)
        translation += change[:3]
        rotation = rotation_of(change[3:]) @ rotation
        if step > 2 and np.max(np.abs(change)) < tolerance:
            break
    _fill_residuals(
        rig, points_body, pixels, lead_s, velocity, rotation, translation, residuals, slopes
    )
    for i in range(n):
        distance[i] = squared_distance(residuals[i], inverse[i])
    if not _determined(normal):
        weighing = -weighing - 1
    return rotation, translation, normal, residuals, distance, weighing


@compiled
def _fill_residuals(
    rig: RigRows,
    points_body: Floats,
    pixels: Floats,
    lead_s: Floats,
    velocity: Floats,
    rotation: Floats,
    translation: Floats,
    residuals: Floats,
    slopes: Floats,
) -> None:
    """Fill the points' residuals (n, 2) and their images' derivatives (n, 2, 6) by the pose."""
    arm, point, turn = np.empty(3), np.empty(3), velocity[3:]
    seen, by_point = np.empty(2), np.empty((2, 3))
    for i in range(len(pixels)):
        for a in range(3):
            arm[a] = 0.0
            for b in range(3):
                arm[a] += rotation[a, b] * points_body[i, b]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            moved = lead_s[i] * (velocity[a] + turn[b] * arm[c] - turn[c] * arm[b])
            point[a] = arm[a] + translation[a] + moved
        project_one(rig, i, point, seen, by_point)
        for u in range(2):
            residuals[i, u] = pixels[i, u] - seen[u]
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                slopes[i, u, a] = by_point[u, a]
                slopes[i, u, 3 + a] = arm[b] * by_point[u, c] - arm[c] * by_point[u, b]


@compiled
def _equations(
    residuals: Floats, slopes: Floats, inverse: Floats, width: float, normal: Floats, right: Floats
) -> int:
    """Fill the normal equations (6, 6), (6,); returns the number of points of non-zero weight."""
    normal[:], right[:] = 0.0, 0.0
    weighing = 0
    weighted = np.empty((6, 2))
    for i in range(len(residuals)):
        distance = squared_distance(residuals[i], inverse[i])
        weight = max(1 - distance / width**2, 0.0) ** 2
        if not (np.isfinite(distance) and weight > 0):
            continue
        weighing += 1
        for a in range(6):
            for u in range(2):
                weighted[a, u] = 0.0
                for v in range(2):
                    weighted[a, u] += slopes[i, v, a] * inverse[i, v, u] * weight
            right[a] += weighted[a, 0] * residuals[i, 0] + weighted[a, 1] * residuals[i, 1]
            for b in range(6):
                normal[a, b] += weighted[a, 0] * slopes[i, 0, b] + weighted[a, 1] * slopes[i, 1, b]
    return weighing


@compiled
def _determined(normal: Floats) -> bool:
    """Whether an information matrix, mm and rad scaled to each other, is not singular."""
    scaled, scale = np.empty((6, 6)), np.empty(6)
    for a in range(6):
        scale[a] = np.sqrt(max(normal[a, a], 1e-30))
    for a in range(6):
        for b in range(6):
            scaled[a, b] = normal[a, b] / (scale[a] * scale[b])
    if not np.all(np.isfinite(scaled)):
        return False
    spread = np.linalg.eigvalsh(scaled)
    return spread[0] > _MIN_EIGENVALUE_RATIO * spread[5]
