"""A pose solver that lays the body on its triangulated balls, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import align_points, propagate, skew
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import BallPosition, Camera, Detection, Motion, Pose


class RigidSettings(Settings):
    """Settings of the `rigid` solver."""

    max_residual_mm: float = setting(
        0.5, "RMS distance of balls from the body beyond which a pose is flagged.", unit="mm", gt=0
    )


class RigidSolver(PoseSolver):
    """Weighted rigid alignment of three positions or more."""

    name = "rigid"
    requires_outlines = False
    Config = RigidSettings
    config: RigidSettings

    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body; None for fewer than three balls, or balls on one line."""
        if len(positions) < 3:
            return None
        balls = tuple(position.ball for position in positions)
        points_body = self.body.centers_of(balls)
        points_world = _points_at(time_s, positions, points_body, prior)
        covariances = np.stack([position.covariance for position in positions])
        weights = 1 / np.trace(covariances, axis1=1, axis2=2)
        try:
            world_from_body = align_points(points_world, points_body, weights)
        except DegenerateGeometryError:
            return None
        placed = world_from_body.apply(points_body)
        residual_mm = float(np.sqrt(np.mean(np.sum((points_world - placed) ** 2, axis=1))))
        return Pose(
            time_s=time_s,
            world_from_body=world_from_body,
            covariance=_covariance(world_from_body.rotate(points_body), weights, covariances),
            residual_mm=residual_mm,
            rms_px=_rms_px(dict(zip(balls, placed, strict=True)), detections, cameras),
            cameras=tuple(sorted({name for p in positions for name in p.cameras})),
            balls=balls,
            flags=self._flags(residual_mm),
        )

    def _flags(self, residual_mm: float) -> tuple[str, ...]:
        if residual_mm <= self.config.max_residual_mm:
            return ()
        return (f"balls lie {residual_mm:.2f} mm from their places on the body",)


def _points_at(
    time_s: float, positions: Sequence[BallPosition], points_body: Floats, prior: Motion | None
) -> Floats:
    """The positions (n, 3) in mm, each moved from its own time to `time_s` as the body moves."""
    points = np.stack([position.center for position in positions])
    if prior is None:
        return points
    own = [prior.at(p.time_s).apply(q) for p, q in zip(positions, points_body, strict=True)]
    return points + prior.at(time_s).apply(points_body) - np.stack(own)


def _covariance(arms: Floats, weights: Floats, covariances: Floats) -> Floats:
    """(6, 6) of the pose, in the chart of `RigidTransform.perturb`.

    A shift t and a turn w of the body move a ball by t + w x arm, `arms` (n, 3) in mm leading from
    the origin to the balls.
    """
    by_pose = np.concatenate([np.tile(np.eye(3), (len(arms), 1, 1)), -skew(arms)], axis=2)
    weighted = weights[:, None, None] * np.swapaxes(by_pose, 1, 2)
    by_point = np.linalg.inv((weighted @ by_pose).sum(axis=0)) @ weighted
    return np.asarray(propagate(by_point, covariances).sum(axis=0))


def _rms_px(
    centers: Mapping[str, Floats], detections: Sequence[Detection], cameras: Mapping[str, Camera]
) -> float:
    """RMS distance in px of the detections from the projected centres; NaN if there are none."""
    errors = [
        cameras[d.camera].project(centers[d.ball][None])[0] - d.center_px
        for d in detections
        if d.ball in centers
    ]
    if not errors:
        return float("nan")
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register `rigid`."""
    return [RigidSolver]
