"""`kabsch`: the rigid fit of the body to its triangulated balls.

The closed form by singular values (Kabsch 1976; Umeyama 1991) starts it; Gauss-Newton with the
positions' full covariances and a robust loss finishes it. Calibration errors shift all positions
together, so their part of the covariance is carried per camera, not per ball.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure import estimation
from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.estimation.losses import Huber
from measure.geometry import (
    RigidTransform,
    align_points,
    chart_jacobian,
    chi_square_quantile,
    propagate,
)
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.limits import MAX_STEPS, SETTLED
from measure.model import BallPosition, Camera, Detection, Motion, Pose


class KabschConfig(Settings):
    """Settings of the `kabsch` solver."""

    distance_tolerance_mm: float = setting(
        0.5,
        "How far a distance between two balls may be from the body file's, beyond what the "
        "positions' covariances explain, before the pose is flagged.",
        unit="mm",
        ge=0,
    )
    huber: float = setting(
        3.0,
        "A position further than this many standard deviations off gets a smaller weight.",
        gt=0,
    )


@dataclass(frozen=True, eq=False)
class _PlacedBall:
    """A ball at the pose's instant: centre (3,) in mm, its covariance (3, 3), and its pixels."""

    point: Floats
    covariance: Floats
    observations: estimation.PointObservations | None


class KabschSolver(PoseSolver):
    """Weighted rigid alignment of three or more positions."""

    name = "kabsch"
    Config = KabschConfig
    config: KabschConfig

    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body from its positions; None for fewer than three, or balls on one line."""
        if len(positions) < 3:
            return None
        at = [self._at(position, detections, cameras, time_s, prior) for position in positions]
        points_body = self.body.centers[[self.body.index(position.ball) for position in positions]]
        centers = np.stack([placed.point for placed in at])
        covariances = np.stack([placed.covariance for placed in at])
        try:
            start = align_points(centers, points_body, 1 / np.trace(covariances, axis1=1, axis2=2))
        except DegenerateGeometryError:
            return None
        weights = _robust_fit(start, centers, covariances, points_body, self.config.huber)
        world_from_body, weight, chi_square = weights
        residuals = centers - world_from_body.apply(points_body)
        return Pose(
            time_s=time_s,
            world_from_body=world_from_body,
            covariance=_covariance(world_from_body, points_body, weight, at, chi_square),
            residual_mm=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
            rms_px=_rms_px(at, world_from_body.apply(points_body)),
            cameras=tuple(sorted({name for position in positions for name in position.cameras})),
            balls=tuple(position.ball for position in positions),
            flags=estimation.layout_flags(
                self.body,
                [f.ball for f in positions],
                centers,
                covariances,
                self.config.distance_tolerance_mm,
            ),
        )

    def _at(
        self,
        position: BallPosition,
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None,
    ) -> _PlacedBall:
        """The position at `time_s`; a moving ball's pixels belong to the cameras' own times."""
        used = [d for d in detections if d.ball == position.ball and d.camera in position.cameras]
        if len(used) < 2:
            return _PlacedBall(position.center, position.covariance, None)
        shifts = np.zeros((len(used), 3))
        if prior is not None:
            center = self.body.centers[self.body.index(position.ball)]
            shifts = np.stack([prior.at(d.time_s).apply(center) for d in used])
            shifts -= prior.at(time_s).apply(center)
        views = estimation.PointObservations.of(used, cameras, shifts)
        if not np.any(views.shifts):
            return _PlacedBall(position.center, position.covariance, views)
        try:
            fit = estimation.fit_point(views)
        except DegenerateGeometryError:
            return _PlacedBall(position.center, position.covariance, None)
        # What the triangulator found doubtful stays doubtful.
        wider = max(1.0, float(np.trace(position.covariance) / np.trace(fit.covariance)))
        return _PlacedBall(fit.point, fit.covariance * wider, views)


def _robust_fit(
    start: RigidTransform, centers: Floats, covariances: Floats, points_body: Floats, huber: float
) -> tuple[RigidTransform, Floats, float]:
    """Gauss-Newton with Huber weights; the pose, the weights (n, 3, 3) and the chi-square."""
    inverse = np.linalg.inv(covariances)
    pose, weight = start, inverse
    for _ in range(MAX_STEPS):
        residuals = centers - pose.apply(points_body)
        distance = np.sqrt(np.einsum("ni,nij,nj->n", residuals, inverse, residuals))
        factor = Huber(huber).weights(distance)
        weight = inverse * factor[:, None, None]
        jacobians = chart_jacobian(pose.rotate(points_body))
        weighted = np.swapaxes(jacobians, 1, 2) @ weight
        step = np.linalg.solve(
            (weighted @ jacobians).sum(axis=0), np.einsum("nij,nj->i", weighted, residuals)
        )
        pose = pose.perturb(step)
        if np.max(np.abs(step)) < SETTLED:
            break
    residuals = centers - pose.apply(points_body)
    return pose, np.asarray(weight), float(np.einsum("ni,nij,nj->", residuals, weight, residuals))


def _covariance(
    pose: RigidTransform,
    points_body: Floats,
    weight: Floats,
    balls: Sequence[_PlacedBall],
    chi_square: float,
) -> Floats:
    """(6, 6): pixel noise ball by ball, and each camera's own error over all balls at once."""
    jacobians = chart_jacobian(pose.rotate(points_body))
    weighted = np.swapaxes(jacobians, 1, 2) @ weight
    by_position = np.linalg.inv((weighted @ jacobians).sum(axis=0)) @ weighted
    out = np.zeros((6, 6))
    by_camera: dict[str, Floats] = {}
    known: dict[str, Floats] = {}
    for placed, lever in zip(balls, by_position, strict=True):
        own, levers = _parts(placed)
        for name, covariance, sensitivity in levers:
            known[name] = covariance
            by_camera[name] = by_camera.get(name, 0.0) + lever @ sensitivity
        out += lever @ own @ lever.T
    degrees = 3 * len(points_body) - 6
    if chi_square > chi_square_quantile(0.99, degrees):
        out = out * (chi_square / degrees)
    for name, total in by_camera.items():
        out += total @ known[name] @ total.T
    return (out + out.T) / 2


def _parts(placed: _PlacedBall) -> tuple[Floats, list[tuple[str, Floats, Floats]]]:
    """A position's covariance (3, 3) without the cameras' part, and the uncertain cameras.

    Of those the names, covariances (18, 18), and how the position reacts to them (3, 18). A
    covariance beyond what pixels and calibration explain, which is how a triangulator flags a
    position, widens the first by the same ratio.
    """
    o = placed.observations
    if o is None or not o.rig.uncertain:
        return placed.covariance, []
    by_pixel, by_camera = estimation.point_sensitivity(o, placed.point)
    own = propagate(by_pixel, o.noise).sum(axis=0)
    shared = propagate(by_pixel, estimation.calibration_noise(o.rig, placed.point + o.shifts)).sum(
        axis=0
    )
    ratio = max(1.0, float(np.trace(placed.covariance) / np.trace(own + shared)))
    cameras = zip(o.rig.names, o.rig.rows.covariances, by_camera, strict=True)
    return own * ratio, [camera for camera in cameras if np.any(camera[1])]


def _rms_px(balls: Sequence[_PlacedBall], centers: Floats) -> float:
    """RMS distance in px of the body's balls, as posed, from their detections; NaN if none."""
    errors = [
        placed.observations.residuals(center)[0]
        for placed, center in zip(balls, centers, strict=True)
        if placed.observations is not None
    ]
    if not errors:
        return float("nan")
    return float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))))


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register `kabsch`."""
    return [KabschSolver]
