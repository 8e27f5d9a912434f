"""The paper's pose: Nelder-Mead over position and Euler angles, fitted to the ball centres.

Peng, Yang, Su, Hannaford (ICRA 2020), section II.E "End Effector Localization".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from math import cos, sin

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, chart_jacobian
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import BallPosition, Camera, Detection, Doubt, Motion, Pose
from measure.model.body import MIN_BREADTH_RATIO


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
            flags=() if converged else (Doubt("simplex"),),
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

    The minimum answers to an error of the positions by the pseudo-inverse of the stacked Jacobians.
    Positions count as independent.
    """
    jacobian = chart_jacobian(pose.rotate(points_body))
    inverse = np.linalg.pinv(jacobian.reshape(-1, 6)).reshape(6, -1, 3)
    noise = np.stack([position.covariance for position in positions])
    return np.asarray(np.einsum("inj,njk,mnk->im", inverse, noise, inverse))


_NEAR_GIMBAL_LOCK = 0.9
"""|sin(beta)| beyond which alpha and gamma nearly turn about one axis and the simplex would
collapse."""


def initial_guess(points_world: Floats, points_body: Floats) -> RigidTransform:
    """The paper's first guess, for any body of three or more balls.

    The paper: the middle of the green and the red ball is the origin, the directions from there to
    the green and the yellow ball are the x and the y axis. In general: the two balls farthest apart
    stand for green and red, the ball farthest from their line for yellow; the same frame is built
    from the measured and from the body's own centres, and the guess lays one on the other. For the
    paper's body the second is the identity.

    Args:
        points_world: (n, 3) measured centres in mm, n >= 3.
        points_body: (n, 3) the same balls in the body frame.

    Raises:
        DegenerateGeometryError: the balls lie on one line.
    """
    green, red = max(
        combinations(range(len(points_body)), 2),
        key=lambda pair: float(np.linalg.norm(points_body[pair[0]] - points_body[pair[1]])),
    )
    middle = (points_body[green] + points_body[red]) / 2
    along = points_body[green] - middle
    off_line = np.linalg.norm(np.cross(points_body - middle, along), axis=1)
    chosen = [green, int(np.argmax(off_line)), red]
    world_from_frame = _frame(points_world[chosen])
    body_from_frame = _frame(points_body[chosen])
    return world_from_frame @ body_from_frame.inverse()


def fit_simplex(
    points_world: Floats,
    points_body: Floats,
    guess: RigidTransform,
    steps: tuple[float, float],
    tolerance: float,
    max_evaluations: int,
) -> tuple[RigidTransform, bool]:
    """Minimise the sum of squared distances (the paper's cost C) by Nelder and Mead's method.

    Args:
        points_world: (n, 3) measured centres in mm.
        points_body: (n, 3) the same balls in the body frame.
        steps: size of the first simplex in mm and rad.
        tolerance: extent of the last simplex in mm and rad.

    Returns:
        world_from_body, and whether the search converged.
    """
    from scipy.optimize import minimize

    # Near beta = +-90 deg Euler angles lose a degree of freedom: look at the world from the side.
    turn = _away_from_gimbal_lock(guess.rotation)
    angles = Rotation.from_matrix(turn @ guess.rotation).as_euler("xyz")  # of Rz Ry Rx
    start = np.concatenate([turn @ guess.translation, angles])
    simplex = np.vstack([start, start + np.diag([steps[0]] * 3 + [steps[1]] * 3)])
    result = minimize(
        _cost(points_world @ turn.T, points_body),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": tolerance,
            "fatol": tolerance**2,
            "maxfev": max_evaluations,
            "maxiter": max_evaluations,
        },
    )
    best = np.asarray(result.x, dtype=np.float64)
    rotation = Rotation.from_euler("xyz", best[3:]).as_matrix()
    pose = RigidTransform(turn.T @ rotation, turn.T @ best[:3])
    return pose, bool(result.success)


def _frame(three_points: Floats) -> RigidTransform:
    """Origin between the first and the last, x towards the first, y towards the second."""
    first, second, last = three_points
    origin = (first + last) / 2
    x, towards_second = first - origin, second - origin
    z = np.cross(x, towards_second)
    length = float(np.linalg.norm(x))
    if np.linalg.norm(z) <= MIN_BREADTH_RATIO * length**2 or length == 0:
        raise DegenerateGeometryError(
            f"three ball centres lie on one line (distance from it "
            f"{np.linalg.norm(z) / max(length, 1e-12):.2f} mm): no pose"
        )
    x, z = x / length, z / np.linalg.norm(z)
    return RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), origin)


def _away_from_gimbal_lock(rotation: Floats) -> Floats:
    """A turn (3, 3) of the world in which beta of `rotation` is far from +-90 deg."""
    if abs(rotation[2, 0]) < _NEAR_GIMBAL_LOCK:
        return np.eye(3)
    return np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def _cost(points_world: Floats, points_body: Floats) -> Callable[[Floats], float]:
    """The paper's C of (x, y, z, alpha, beta, gamma); plain floats, for it is called 500 times."""
    pairs = [
        (*world, *body)
        for world, body in zip(points_world.tolist(), points_body.tolist(), strict=True)
    ]

    def cost(unknowns: Floats) -> float:
        x, y, z, alpha, beta, gamma = unknowns.tolist()
        ca, sa, cb, sb = cos(alpha), sin(alpha), cos(beta), sin(beta)
        cg, sg = cos(gamma), sin(gamma)
        r00, r01, r02 = cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa
        r10, r11, r12 = sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa
        r20, r21, r22 = -sb, cb * sa, cb * ca
        total = 0.0
        for wx, wy, wz, bx, by, bz in pairs:
            ex = r00 * bx + r01 * by + r02 * bz + x - wx
            ey = r10 * bx + r11 * by + r12 * bz + y - wy
            ez = r20 * bx + r21 * by + r22 * bz + z - wz
            total += ex * ex + ey * ey + ez * ez
        return total

    return cost
