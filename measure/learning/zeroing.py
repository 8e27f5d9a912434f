"""Offsets of joint zeros and base after a restart, from a short measured stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import EstimatorError
from measure.robots import SerialChain, StateSchema

_MIN_STATES = 10
_PRIOR_SD_MM = 2.0  # of the tip's offset by each joint's zero and by the base
_CORRELATED_STATES = 5.0  # hysteresis correlates neighbours: so many count as one observation
_HUBER_SDS = 2.5
_MIN_SCALE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Zeroing:
    """A correction of joint zeros and of the base, on top of a model's.

    A constant offset of a joint is not constant at the tip: it depends on the pose. So where the
    kinematics are known, the joints are corrected.
    """

    shift_mm: Floats  # (3,) of the tip, the same everywhere
    joints: Floats  # (k,) rad or mm, to add to the joint readings; empty without kinematics
    readings: Floats  # (features, k) from a state to the joints
    chain: SerialChain | None  # the robot's kinematics, if known
    mean_mm: Floats  # (3,) the offset of the tip, averaged over the stretch
    covariance: Floats  # (3, 3) mm^2 of the offset, averaged over the stretch

    @property
    def sd_mm(self) -> float:
        """3-D standard deviation of the offset."""
        return float(np.sqrt(np.trace(self.covariance)))

    def offset_mm(self, states: Floats) -> Floats:
        """Offset (..., 3) in mm to add to the corrections of states (..., features)."""
        if self.chain is None:
            return np.broadcast_to(self.shift_mm, (*states.shape[:-1], 3))
        q = states @ self.readings
        tips = self.chain.tip_mm(np.stack([q + self.joints, q], axis=-2))
        return np.asarray(tips[..., 0, :] - tips[..., 1, :] + self.shift_mm)


def fit_zeroing(schema: StateSchema, states: Floats, residuals_mm: Floats) -> Zeroing:
    """The zeros that explain a stretch's residuals.

    Bayesian linear regression with Huber's weights on the Jacobian's columns and three constants;
    the prior has zero mean.

    Args:
        states: (n, features).
        residuals_mm: (n, 3) measured minus corrected position.

    Raises:
        EstimatorError: fewer than 10 measured states.
    """
    floats("residuals_mm", residuals_mm, len(states), 3)
    if len(states) < _MIN_STATES:
        raise EstimatorError(
            f"re-zeroing needs at least {_MIN_STATES} measured states, got {len(states)}"
        )
    design, lever = _design(schema, states)
    found, scatter = _regression(design, residuals_mm)
    within = np.einsum("nij,jk,nlk->il", design, scatter, design) / len(design)
    return Zeroing(
        shift_mm=found[-3:],
        joints=found[:-3] / lever,
        readings=schema.reading_matrix(schema.joints),
        chain=schema.chain,
        mean_mm=(design @ found).mean(axis=0),
        covariance=within,
    )


def _design(schema: StateSchema, states: Floats) -> tuple[Floats, Floats]:
    """Columns (n, 3, k + 3) of unknowns in mm, and the tip's motion (k,) per unit of each joint."""
    constants = np.tile(np.eye(3), (len(states), 1, 1))
    if schema.chain is None:
        return constants, np.zeros(0)
    jacobian = schema.chain.jacobian(schema.joint_positions(states))[:, :3]
    lever = np.maximum(np.sqrt((jacobian**2).sum(axis=1).mean(axis=0)), 1e-9)
    return np.concatenate([jacobian / lever, constants], axis=2), lever


def _regression(design: Floats, residuals: Floats) -> tuple[Floats, Floats]:
    """Unknowns and their covariance."""
    prior = np.eye(design.shape[2]) / _PRIOR_SD_MM**2
    found: Floats = np.zeros(len(prior))
    covariance: Floats = np.zeros(prior.shape)
    for _ in range(5):
        left = np.linalg.norm(residuals - design @ found, axis=1)
        scale = max(float(np.median(left)) / 1.54, _MIN_SCALE_MM)  # of a 3-D normal, per axis
        weights = np.minimum(1.0, _HUBER_SDS * scale / np.maximum(left, 1e-12))
        weights /= _CORRELATED_STATES * scale**2
        normal = np.einsum("nij,n,nik->jk", design, weights, design) + prior
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        found = covariance @ np.einsum("nij,n,ni->j", design, weights, residuals)
    return found, covariance
