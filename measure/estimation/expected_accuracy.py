"""Standard deviations to expect of a body's pose: from image noise, calibration and body file.

With J the Jacobian of all ball centres by the pose, errors d of what is compared with them move the
least-squares pose by -(J^T J)^-1 J^T d, and the covariance of d travels through that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform, chart_jacobian
from measure.limits import SINGULAR
from measure.model import Body, Camera, Detection


def noise_sd(
    pose: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    noise_px: float,
    behind: float = 1.0,
) -> tuple[float, float]:
    """Standard deviations of position (3-D, mm) and rotation (deg) from image noise alone.

    Every ball counts in every image that it lies in; NaN where fewer than two cameras see the body.

    Args:
        pose: world_from_body.
        noise_px: standard deviation of a ball's centre in an image, per axis.
        behind: times as much where another ball hides a part of it.
    """
    centers = pose.apply(body.centers)
    seen = []
    for camera in cameras:
        pixels = camera.project(centers)
        inside = camera.intrinsics.contains(pixels)
        hidden = camera.hides(centers, body.radii, 1.0).any(axis=1)
        sd_px = noise_px * np.where(hidden, behind, 1.0)
        seen += [
            Detection(ball, camera.name, 0.0, pixel, 1.0, sd**2 * np.eye(2))
            for ball, pixel, sd, ok in zip(body.names, pixels, sd_px, inside, strict=True)
            if ok
        ]
    if len({d.camera for d in seen}) < 2:
        return float("nan"), float("nan")
    try:
        by_name = {camera.name: camera for camera in cameras}
        fit = fit_pose(pose, PoseObservations.of(seen, body, by_name, 0.0))
    except DegenerateGeometryError:
        return float("nan"), float("nan")
    return _mm_and_deg(fit.covariance)


def tolerance_covariance(
    body: Body, world_from_body: RigidTransform, balls: Sequence[str]
) -> Floats:
    """Covariance (6, 6) of the pose, in its `perturb` chart, from misplaced balls.

    With J_i = [1, -[R c_i]x] and independent, isotropic displacements of the balls, it is
    tolerance^2 (sum J_i^T J_i)^-1. Directions that the balls used leave undetermined get zero.

    Args:
        balls: names of those it was measured with.
    """
    J = chart_jacobian(world_from_body.rotate(body.centers_of(balls))).reshape(-1, 6)
    share = np.linalg.pinv(J.T @ J, rcond=SINGULAR, hermitian=True)
    return np.asarray(body.tolerance_mm**2 * share, dtype=np.float64)


def tolerance_sd(body: Body, world_from_body: RigidTransform) -> tuple[float, float]:
    """Standard deviations of position (3-D, mm) and rotation (deg) from all balls' tolerance."""
    return _mm_and_deg(tolerance_covariance(body, world_from_body, body.names))


def body_pose_sd(
    cameras: Sequence[Camera],
    body: Body,
    poses: Sequence[RigidTransform],
    covariance: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Standard deviations of a body's pose from the calibration's own uncertainty.

    Args:
        cameras: with covariances.
        poses: n of them.
        covariance: of all cameras' poses and free lens parameters together, camera after camera (as
            from a rig fit); by camera if omitted, which ignores correlations between cameras.

    Returns:
        Standard deviations (n,) of the 3-D position in mm and of the rotation in rad.
    """
    position, rotation = [], []
    for pose in poses:
        P = _calibration_covariance(cameras, body, pose, covariance)
        position.append(np.sqrt(np.trace(P[:3, :3])))
        rotation.append(np.sqrt(np.trace(P[3:, 3:])))
    return np.array(position), np.array(rotation)


def pose_by_cameras(
    cameras: Sequence[Camera], body: Body, pose: RigidTransform
) -> tuple[Floats, ...]:
    """How a body's pose moves (6, 18) with each camera's pose and lens; not at all where unseen.

    Args:
        cameras: that see the body.
        pose: world_from_body.
    """
    return pose_by_views([(camera, pose.apply(body.centers)) for camera in cameras], pose)[1]


def pose_by_views(
    views: Sequence[tuple[Camera, Floats]], pose: RigidTransform
) -> tuple[Floats, tuple[Floats, ...]]:
    """The pose of what carries points, by pixels of equal weight.

    Args:
        views: cameras, and points (n, 3) in the world that each sees.
        pose: world_from_body.

    Returns:
        Its covariance (6, 6) for pixels of variance 1, and how it moves (6, 18) with each camera's
        pose and lens; not at all where that sees no image of a point.
    """
    normal, parts = np.zeros((6, 6)), []
    for camera, points in views:
        _, by_world, *by_camera = camera.project_with_jacobians(points)
        if not np.all(np.isfinite(by_world)):
            parts.append(np.zeros((6, 18)))
            continue
        J = (by_world @ chart_jacobian(points - pose.translation)).reshape(-1, 6)
        normal += J.T @ J
        parts.append(J.T @ np.concatenate(by_camera, axis=2).reshape(-1, 18))
    scale = 1 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
    return inverse, tuple(inverse @ part for part in parts)


def by_each_calibration(cameras: Iterable[Camera], parts: Iterable[Floats]) -> Floats:
    """What the cameras' own covariances do to a pose (6, 6) that moves (6, 18) with each camera."""
    known = ((c.covariance, part) for c, part in zip(cameras, parts, strict=True))
    return sum((J @ P @ J.T for P, J in known if P is not None), np.zeros((6, 6)))


def _calibration_covariance(
    cameras: Sequence[Camera], body: Body, pose: RigidTransform, covariance: Floats | None
) -> Floats:
    parts = pose_by_cameras(cameras, body, pose)
    if covariance is None:
        return by_each_calibration(cameras, parts)
    both = zip(cameras, parts, strict=True)
    by_cameras = np.concatenate([part[:, camera.free] for camera, part in both], axis=1)
    return by_cameras @ covariance @ by_cameras.T


def _mm_and_deg(covariance: Floats) -> tuple[float, float]:
    """Standard deviations of position (3-D, mm) and rotation (deg) of a pose's covariance."""
    variances = np.diag(covariance)
    return float(np.sqrt(variances[:3].sum())), float(np.degrees(np.sqrt(variances[3:].sum())))
