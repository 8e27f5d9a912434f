"""The tip of a tool that is turned about a fixed point, and the axis of one that is spun.

With the tip at p in the body and at q in the world, every pose has R p + t = q. Rotations are
measured too, so the equations are linearised at the adjusted poses (Gauss-Helmert model, see
Mikhail and Ackermann 1976, Observations and Least Squares, chapter 7); at the measured ones p would
come out too short.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, rms_length
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, chi_square_quantile, propagate, skew
from measure.metrology.poses import PoseTable, SharedErrors

_FEWEST = 10
_LEAST_SWING_DEG = 15.0
"""Within fewer degrees the errors of a pose by light stay alike, and turning averages nothing."""
_WORST_TIP_SD_MM = 0.5  # A tip that is known worse, along any axis, is none
_TUKEY = 6.0  # A pose this many standard deviations off has no weight at all
_LEAST_USED = 0.6  # Share of the poses that must agree on the point
_SLIPPING = 3.0  # Times what the poses state, from which the tip itself is taken to have moved
_STEPS = 30


@dataclass(frozen=True, eq=False)
class Pivot:
    """A tip."""

    tip_mm: Floats  # (3,) in the body
    tip_covariance: Floats  # (3, 3) in mm^2
    point_mm: Floats  # (3,) where it stood, in the world
    rms_mm: float  # of the tip's distance from there, over the poses used
    normalised: float  # mean squared distance over what the poses' covariances say; 1 is right
    poses: int  # how many were used
    left_out: int  # how many were not, for they disagree
    swing_deg: float  # opening of a filled cone that shows as much, in its narrowest direction
    needed_deg: float  # how far it must be turned at least

    @property
    def tip_sd_mm(self) -> float:
        """Standard deviation of the tip, 3-D."""
        return float(np.sqrt(np.trace(self.tip_covariance)))


@dataclass(frozen=True, eq=False)
class SpinAxis:
    """The axis about which a body was spun."""

    direction: Floats  # (3,) unit vector in the body, from the tip towards the balls
    sd_deg: float  # its standard deviation across
    turned_deg: float  # how far the body was turned about it


def find_tip(poses: PoseTable, shared: SharedErrors) -> Pivot:
    """The body's point that stays while it turns; DegenerateGeometryError if poses show none."""
    _refuse_few(poses)
    swing = _full_cone_deg(np.linalg.eigvalsh(_turning(poses.world_from_body.rotation))[0])
    if swing < _LEAST_SWING_DEG:
        raise DegenerateGeometryError(_too_little(swing, _LEAST_SWING_DEG))
    tip, point, weights = _fit(poses)
    used = weights > 0
    if np.mean(used) < _LEAST_USED:
        raise DegenerateGeometryError(
            f"no point of the body stays where it is: only {used.sum()} of {len(poses)} poses "
            "agree on one; record the pivoting alone, with the tip in a hole that holds it"
        )
    kept = poses.take(np.flatnonzero(used))
    covariance, normalised = _tip_covariance(kept, tip, point, shared)
    rms = rms_length(kept.world_from_body.apply(tip) - point)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    needed = max(_LEAST_SWING_DEG, swing * worst / _WORST_TIP_SD_MM)
    if swing < needed and normalised > _SLIPPING**2:
        raise DegenerateGeometryError(
            f"the tip does not stay where it is: it wanders by {rms:.2f} mm RMS, "
            f"{np.sqrt(normalised):.0f} times what the poses state; hold it in a small hole"
        )
    if swing < needed:
        raise DegenerateGeometryError(_too_little(swing, needed))
    left_out = len(poses) - len(kept)
    return Pivot(tip, covariance, point, rms, normalised, len(kept), left_out, swing, needed)


def find_spin_axis(poses: PoseTable, shared: SharedErrors, tip_mm: Floats) -> SpinAxis:
    """The body's direction that stays while it is spun; DegenerateGeometryError if none does."""
    _refuse_few(poses)
    values, axes = np.linalg.eigh(_turning(poses.world_from_body.rotation))
    axis = axes[:, 0]
    turned = _full_cone_deg(values[1])
    if turned < _LEAST_SWING_DEG or values[0] > 0.1 * values[1]:
        raise DegenerateGeometryError(
            f"the body was turned by {turned:.0f} deg about the axis and by "
            f"{_full_cone_deg(values[0]):.0f} deg across: at least {_LEAST_SWING_DEG:.0f} "
            "deg about one axis alone are needed"
        )
    P = _axis_covariance(poses, axes, values, shared)
    direction = axis if axis @ (shared.body.middle - tip_mm) >= 0 else -axis
    return SpinAxis(direction, float(np.degrees(np.sqrt(np.trace(P)))), _turned_deg(poses, axis))


def _refuse_few(poses: PoseTable) -> None:
    if len(poses) < _FEWEST:
        raise DegenerateGeometryError(
            f"a turning body is seen in {len(poses)} poses that can be relied on: at least "
            f"{_FEWEST} are needed"
        )


def _too_little(swing_deg: float, needed_deg: float) -> str:
    return (
        f"the body was turned by {swing_deg:.0f} deg in its narrowest direction, and at least "
        f"{np.ceil(needed_deg):.0f} deg are needed to show its tip: tilt it further, to all sides"
    )


def _turning(rotations: Floats) -> Floats:
    """Mean square (3, 3) of how directions of the body move in the world."""
    centred = rotations - rotations.mean(axis=0)
    return np.asarray(np.einsum("nji,njk->ik", centred, centred) / len(centred))


def _full_cone_deg(mean_square: float) -> float:
    """Opening angle of an evenly filled cone in which directions across it move as much."""
    return 4 * float(np.degrees(np.sqrt(max(mean_square, 0.0))))


def _turned_deg(poses: PoseTable, axis: Floats) -> float:
    """How far a body was turned about an axis of its own, over all poses."""
    turns = (poses.world_from_body[:1].inverse() @ poses.world_from_body).quat_wxyz
    return float(np.degrees(np.ptp(np.unwrap(2 * np.arctan2(turns[:, 1:] @ axis, turns[:, 0])))))


def _fit(poses: PoseTable) -> tuple[Floats, Floats, Floats]:
    """Tip (3,) in the body, point (3,) in the world, weights (n,)."""
    measured = poses.world_from_body
    rows = np.concatenate([measured.rotation, np.broadcast_to(-np.eye(3), (len(poses), 3, 3))], 2)
    x = np.linalg.lstsq(rows.reshape(-1, 6), -measured.translation.reshape(-1))[0]
    adjusted, v, weights = measured, np.zeros((len(poses), 6)), np.ones(len(poses))
    for _ in range(_STEPS):
        A, H, inverse = _linearised(adjusted, x[:3], poses.covariances)
        w = adjusted.apply(x[:3]) - x[3:] + np.einsum("nij,nj->ni", H, v)
        weights = _tukey_weights(np.einsum("ni,nij,nj->n", w, inverse, w))
        weighted = np.swapaxes(A, 1, 2) @ (weights[:, None, None] * inverse)
        step = -np.linalg.solve((weighted @ A).sum(axis=0), np.einsum("nij,nj->i", weighted, w))
        x = x + step
        rest = np.einsum("nij,nj->ni", inverse, w + A @ step)
        v = np.einsum("nij,nkj,nk->ni", poses.covariances, H, rest)
        v[weights == 0] = 0.0
        adjusted = measured.perturb(-v)
        if np.max(np.abs(step)) < 1e-5:
            break
    return x[:3], x[3:], weights


def _linearised(
    adjusted: RigidTransform, tip: Floats, covariances: Floats
) -> tuple[Floats, Floats, Floats]:
    """Of R p + t - q: derivatives (n, 3, 6) by p and q, and by the pose; inverse covariances."""
    R = adjusted.rotation
    unit = np.broadcast_to(np.eye(3), R.shape)
    A, H = np.concatenate([R, -unit], axis=2), np.concatenate([unit, -skew(R @ tip)], axis=2)
    return A, H, np.asarray(np.linalg.inv(propagate(H, covariances)), dtype=np.float64)


def _tukey_weights(squares: Floats) -> Floats:
    scale = np.median(squares) / chi_square_quantile(0.5, 3)
    return np.asarray(np.maximum(1 - squares / max(scale * _TUKEY**2, 1e-300), 0.0) ** 2)


def _tip_covariance(
    poses: PoseTable, tip: Floats, point: Floats, shared: SharedErrors
) -> tuple[Floats, float]:
    """Covariance (3, 3) of the tip, and how large residuals are compared with what is stated."""
    A, H, inverse = _linearised(poses.world_from_body, tip, poses.covariances)
    weighted = np.swapaxes(A, 1, 2) @ inverse
    gains = np.linalg.solve((weighted @ A).sum(axis=0), weighted @ H)[:, :3]
    residuals = poses.world_from_body.apply(tip) - point
    white = np.einsum("nji,nj->ni", np.linalg.cholesky(inverse), residuals)
    normalised = float(np.mean(white**2) * len(poses) / (len(poses) - 2))
    scatter = float(np.mean(np.diff(white, axis=0) ** 2) / 2)
    # What does not scatter from pose to pose and is larger than stated: a tip that creeps.
    excess = max(normalised / max(scatter, 1.0), 1.0)
    return shared.of_sum(gains, poses, scatter) * excess, normalised


def _axis_covariance(
    poses: PoseTable, axes: Floats, values: Floats, shared: SharedErrors
) -> Floats:
    """Covariance (3, 3) of the first of `axes` (3, 3), about which the body was spun.

    An error w of a rotation R moves the axis a, as the world sees it, by w x R a.
    """
    R = poses.world_from_body.rotation
    lever = -skew(R @ axes[:, 0])
    gains = np.zeros((len(poses), 3, 6))
    across = axes[:, 1:] / (len(poses) * values[1:]) @ axes[:, 1:].T
    gains[:, :, 3:] = across @ np.swapaxes(R - R.mean(axis=0), 1, 2) @ lever
    seen = R @ axes[:, 0]
    stated = np.trace(propagate(lever, poses.covariances[:, 3:, 3:]), axis1=1, axis2=2)
    scatter = np.mean(np.sum(np.diff(seen, axis=0) ** 2, axis=1)) / (2 * np.mean(stated))
    return shared.of_sum(gains, poses, float(scatter))
