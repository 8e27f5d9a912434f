"""Offsets of joint zeros and base after a restart, from a short measured stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import EstimatorError
from measure.robots import SerialChain, StateSchema

_MIN_STATES = 10
PRIOR_SD_MM = 0.5  # of the tip's offset by each joint's zero and by the base, where not learnt
PRIOR_LIMITS_MM = 0.1, 2.0
_MIN_INDEPENDENT = 8.0  # observations, as their autocorrelation counts them
_CONVINCING = 0.15  # share of one half's squares left by the other's zeros that is proof enough
_APART = 0.6  # independent ones among them from which on poses are far apart in time
_CHANCE = 2.0  # over the number of states: how much worse a half may do by chance
_MIN_SPREAD = 0.5  # of the joints' SDs, as a share of those in training
_CURE = "measure ten poses or more, spread over the workspace"
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


def fit_zeroing(
    schema: StateSchema,
    states: Floats,
    residuals_mm: Floats,
    *,
    prior_sd_mm: float = PRIOR_SD_MM,
    spread_sd: Floats | None = None,
) -> Zeroing:
    """The zeros that explain a stretch's residuals.

    Bayesian linear regression with Huber's weights on the Jacobian's columns and three constants;
    the prior has zero mean. Observations count as many as are independent, by the autocorrelation
    of what is left.

    Args:
        states: (n, features), in order of time.
        residuals_mm: (n, 3) measured minus corrected position.
        prior_sd_mm: what each joint's zero, and the base, may move the tip by.
        spread_sd: (k,) of the joints (else the position) in training, if known: poses at one place
            tell that place's error.

    Raises:
        EstimatorError: fewer than 10 measured states, all at one place, the zeros of one half
            predict the other worse than none, or not clearly better from fewer than 8 independent
            ones.
    """
    floats("residuals_mm", residuals_mm, len(states), 3)
    if len(states) < _MIN_STATES:
        raise EstimatorError(
            f"re-zeroing needs at least {_MIN_STATES} measured states, got {len(states)}"
        )
    independent = _independent(residuals_mm)
    apart = independent > _APART * len(states)
    if spread_sd is not None and len(spread_sd):
        moved = schema.read(states, schema.joints or schema.position).std(axis=0)
        wide = moved / np.maximum(spread_sd, 1e-9)
        if (spread := float(np.sqrt((wide**2).mean()))) < _MIN_SPREAD:
            raise EstimatorError(
                f"the joints of the {len(states)} measured states spread over {spread:.0%} of what "
                f"they did in training, {_MIN_SPREAD:.0%} are needed: {_CURE}"
            )
    design, lever = _design(schema, states)
    left = _check_halves(design, residuals_mm, prior_sd_mm)
    if independent < _MIN_INDEPENDENT and not apart and left > _CONVINCING:
        raise EstimatorError(
            f"the {len(states)} measured states tell as much of the zeros as {independent:.1f} "
            f"independent ones, their errors being alike, {_MIN_INDEPENDENT:g} are needed: {_CURE}"
        )
    found, scatter = _regression(design, residuals_mm, prior_sd_mm)
    within = np.einsum("nij,jk,nlk->il", design, scatter, design) / len(design)
    return Zeroing(
        shift_mm=found[-3:],
        joints=found[:-3] / lever,
        readings=schema.reading_matrix(schema.joints),
        chain=schema.chain,
        mean_mm=(design @ found).mean(axis=0),
        covariance=within,
    )


def _check_halves(design: Floats, residuals: Floats, prior_sd_mm: float) -> float:
    """Refuse zeros that hold in one half only; the share of the squares left of the other."""
    half = len(residuals) // 2
    before, after = 0.0, 0.0
    for learnt, other in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        found, _ = _regression(design[learnt], residuals[learnt], prior_sd_mm)
        without = np.linalg.norm(residuals[other], axis=1)
        left = np.linalg.norm(residuals[other] - design[other] @ found, axis=1)
        far = 3.0 * np.median(without)  # single false detections must not decide
        before += float(np.minimum(without, far) @ np.minimum(without, far))
        after += float(np.minimum(left, far) @ np.minimum(left, far))
    if after >= before * (1.0 + _CHANCE / len(residuals)):
        rms = np.sqrt(np.array([after, before]) / len(residuals))
        raise EstimatorError(
            f"re-zeroing would do harm: the offsets of one half of the {len(residuals)} measured "
            f"states leave {rms[0]:.2f} mm RMS of the other, none leave {rms[1]:.2f}: {_CURE}"
        )
    return after / before


def _independent(residuals: Floats) -> float:
    """Of how many independent observations (n, 3) know as much: n / (1 + 2 sum of correlations).

    Errors of neighbours are alike, for hysteresis lasts until the robot turns back.
    """
    count, residuals = len(residuals), residuals - residuals.mean(axis=0)
    total, power = 1.0, max(float((residuals**2).sum()), 1e-12)
    for lag in range(1, count // 2):
        correlation = float((residuals[lag:] * residuals[:-lag]).sum()) / power
        if correlation < 1.0 / np.sqrt(count):  # as chance makes it
            break
        total += 2.0 * correlation
    return count / total


def _design(schema: StateSchema, states: Floats) -> tuple[Floats, Floats]:
    """Columns (n, 3, k + 3) of unknowns in mm, and the tip's motion (k,) per unit of each joint."""
    constants = np.tile(np.eye(3), (len(states), 1, 1))
    if schema.chain is None:
        return constants, np.zeros(0)
    jacobian = schema.chain.jacobian(schema.joint_positions(states))[:, :3]
    lever = np.maximum(np.sqrt((jacobian**2).sum(axis=1).mean(axis=0)), 1e-9)
    return np.concatenate([jacobian / lever, constants], axis=2), lever


def _regression(design: Floats, residuals: Floats, prior_sd_mm: float) -> tuple[Floats, Floats]:
    """Unknowns and their covariance."""
    prior = np.eye(design.shape[2]) / prior_sd_mm**2
    share = _independent(residuals) / len(residuals)
    found: Floats = np.zeros(len(prior))
    covariance: Floats = np.zeros(prior.shape)
    for _ in range(5):
        left = residuals - design @ found
        size = np.maximum(np.linalg.norm(left, axis=1), 1e-12)
        scale = max(float(np.median(size)) / 1.54, _MIN_SCALE_MM)  # of a 3-D normal, per axis
        weights = np.minimum(1.0, _HUBER_SDS * scale / size)
        weights *= share / scale**2
        normal = np.einsum("nij,n,nik->jk", design, weights, design) + prior
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        found = covariance @ np.einsum("nij,n,ni->j", design, weights, residuals)
    return found, covariance
