"""The paper's pose: Nelder-Mead over position and Euler angles, fitted to the ball centres.

Peng, Yang, Su, Hannaford (ICRA 2020), section II.E "End Effector Localization".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import BallPosition, Camera, Detection, Motion, Pose
from measure_plugins.pose_solvers._simplex_fit import fit_simplex, initial_guess


class SimplexSettings(Settings):
    """Settings of `simplex`."""

    first_step_mm: float = setting(
        1.0, "Size of the first simplex in position.", unit="mm", gt=0, le=1e3
    )
    first_step_deg: float = setting(
        1.5, "Size of the first simplex in angle.", unit="deg", gt=0, le=90
    )
    tolerance: float = setting(
        1e-5, "Extent of the simplex, in mm and rad, at which the search ends.", gt=0, le=1
    )
    max_evaluations: int = setting(
        4000, "Largest number of evaluations of the cost function.", ge=100
    )


class SimplexSolver(PoseSolver):
    """Least squares between measured and predicted ball centres by the Nelder-Mead method."""

    name = "simplex"
    Config = SimplexSettings
    config: SimplexSettings

    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body from three or more positions; see `PoseSolver.solve`."""
        if len(positions) < 3:
            return None
        rows = [self.body.index(position.ball) for position in positions]
        points_body = self.body.centers[rows]
        points_world = np.stack([position.center for position in positions])
        try:
            guess = initial_guess(points_world, points_body)
        except DegenerateGeometryError:
            return None
        pose, converged = fit_simplex(
            points_world,
            points_body,
            guess,
            steps=(self.config.first_step_mm, np.radians(self.config.first_step_deg)),
            tolerance=self.config.tolerance,
            max_evaluations=self.config.max_evaluations,
        )
        misses = pose.apply(points_body) - points_world
        return Pose(
            time_s=time_s,
            world_from_body=pose,
            covariance=_covariance(pose, points_body, positions),
            residual_mm=float(np.sqrt(np.mean(np.sum(misses**2, axis=1)))),
            rms_px=self._reprojection_rms(pose, positions, detections, cameras),
            cameras=tuple(
                name for name in cameras if any(name in position.cameras for position in positions)
            ),
            balls=tuple(position.ball for position in positions),
            flags=() if converged else ("the simplex search did not converge",),
        )

    def _reprojection_rms(
        self,
        pose: RigidTransform,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
    ) -> float:
        """Over the detections that made the positions; the circle's centre counts as the ball's."""
        used = {(position.ball, camera) for position in positions for camera in position.cameras}
        errors = [
            cameras[d.camera].project(pose.apply(self.body.centers[self.body.index(d.ball)])[None])[
                0
            ]
            - d.center_px
            for d in detections
            if (d.ball, d.camera) in used
        ]
        if not errors:
            return float("nan")
        return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register the solver."""
    return [SimplexSolver]


def _covariance(
    pose: RigidTransform, points_body: Floats, positions: Sequence[BallPosition]
) -> Floats:
    """(6, 6) in the pose's `perturb` chart, to first order, of the unweighted least squares.

    A ball moves by dt + w x (R p), so its Jacobian is [I, -skew(R p)]; the minimum answers to an
    error of the positions by the pseudo-inverse of the stacked Jacobians. Positions count as
    independent.
    """
    turned = pose.rotate(points_body)
    jacobian = np.concatenate([np.tile(np.eye(3), (len(turned), 1, 1)), -skew(turned)], axis=2)
    inverse = np.linalg.pinv(jacobian.reshape(-1, 6)).reshape(6, -1, 3)
    noise = np.stack([position.covariance for position in positions])
    return np.asarray(np.einsum("inj,njk,mnk->im", inverse, noise, inverse))
