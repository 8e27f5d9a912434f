"""What a restart leaves: joints homed a little differently, found from a short measured stretch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import EstimatorError
from measure.robots import SerialChain, StateSchema

_LEAST = 10  # measured states
_PRIOR_SD_MM = 2.0  # how much each joint's zero, and the base, are expected to move the tip
_CORRELATED = 5.0  # hysteresis makes neighbours alike: so many count as one observation
_HUBER = 2.5  # residuals beyond so many SDs count linearly
_LEAST_SCALE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Zeroing:
    """A correction of joint zeros and of the base, on top of a model's.

    A constant at the joints is none at the tip: what a wrist homed 1 degree off does depends on
    where the wrist points. So where the kinematics are known the joints are corrected.

    Attributes:
        shift_mm: (3,) of the tip, the same everywhere.
        joints: (k,) rad or mm, to add to the joint readings; empty without kinematics.
        readings: (features, k) from a state to the joints.
        chain: the robot's kinematics, if known.
        mean_mm: (3,) the offset of the tip, averaged over the stretch.
        covariance: (3, 3) mm^2 of the offset, averaged over the stretch.
    """

    shift_mm: Floats
    joints: Floats
    readings: Floats
    chain: SerialChain | None
    mean_mm: Floats
    covariance: Floats

    @property
    def sd_mm(self) -> float:
        """3-D standard deviation of the offset."""
        return float(np.sqrt(np.trace(self.covariance)))

    def offset_mm(self, states: Floats) -> Floats:
        """What to add to the corrections (..., 3) of states (..., features)."""
        if self.chain is None:
            return np.broadcast_to(self.shift_mm, (*states.shape[:-1], 3))
        q = states @ self.readings
        angles = np.stack([q + self.joints, q], axis=-2)[..., None, None]
        constant, cosine, sine, linear = self._parts
        steps = constant + cosine * np.cos(angles) + sine * np.sin(angles) + linear * angles
        point = steps[..., -1, :, 3:]
        for index in range(self.chain.size - 2, -1, -1):
            point = steps[..., index, :, :] @ point
        return point[..., 0, :3, 0] - point[..., 1, :3, 0] + self.shift_mm

    @cached_property
    def _parts(self) -> tuple[Floats, Floats, Floats, Floats]:
        assert self.chain is not None
        return self.chain.parts()


def fit_zeroing(schema: StateSchema, states: Floats, residuals_mm: Floats) -> Zeroing:
    """The zeros that explain a stretch's residuals, shrunk towards none as far as it leaves open.

    Bayesian linear regression with Huber's weights on the Jacobian's columns and three constants.

    Args:
        schema: of the states.
        states: (n, features).
        residuals_mm: (n, 3) measured minus corrected position.

    Raises:
        EstimatorError: fewer than 10 measured states.
    """
    floats("residuals_mm", residuals_mm, len(states), 3)
    if len(states) < _LEAST:
        raise EstimatorError(
            f"re-zeroing needs at least {_LEAST} measured states, got {len(states)}"
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
    """Columns (n, 3, k + 3) of unknowns in mm, and what each joint's unit moves the tip (k,)."""
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
        scale = max(float(np.median(left)) / 1.54, _LEAST_SCALE_MM)  # of a 3-D normal, per axis
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(left, 1e-12))
        weights /= _CORRELATED * scale**2
        normal = np.einsum("nij,n,nik->jk", design, weights, design) + prior
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        found = covariance @ np.einsum("nij,n,ni->j", design, weights, residuals)
    return found, covariance
