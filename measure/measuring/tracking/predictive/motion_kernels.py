"""Prediction and update of the motion filter, compiled: see `motion_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.geometry.rotation_kernels import rotation_of, rotvec_of

_PRIOR_WEIGHT = 0.5
"""Weight of a prior autocorrelation of 1, in observed accelerations: a few alone say little."""
_MIN_VARIANCE_RATIO = 1 / 64
"""Least variance of the acceleration, of the configured one: a body at rest may start to move."""
_MAX_VARIANCE_RATIO = 16
"""Largest variance of the acceleration, of the configured one: more is taken for an error."""


class Kinematics(NamedTuple):
    """How a body moves at an instant, in the world."""

    velocity: Floats  # (6,) mm/s and rad/s
    acceleration: Floats  # (6,) expected from here on, mm/s^2 and rad/s^2
    duration_s: float


class AccelerationMoments(NamedTuple):
    """Moments of the accelerations observed so far, mm/s^2 and rad/s^2."""

    last: Floats  # (6,) the last one
    square: Floats  # (6, 6) mean of a a^T; zero if none was observed
    product: Floats  # (6,) mean product of each with the one before


class FilterState(NamedTuple):
    """The state of the filter."""

    rotation: Floats  # (3, 3) of world_from_body
    translation: Floats  # (3,) the same, mm
    kinematics: Kinematics
    covariance: Floats  # (12, 12) of pose and velocity
    accelerations: AccelerationMoments  # observed so far


@compiled
def propagated_covariance(covariance: Floats, dt: float, variance: Floats) -> Floats:
    """The covariance (12, 12) of pose and velocity `dt` seconds on: see `MotionState.at`.

    Args:
        covariance: (12, 12).
        dt: s, of either sign.
        variance: (6,) of the acceleration.
    """
    out = covariance.copy()
    for i in range(6):
        for j in range(12):
            out[i, j] += dt * covariance[6 + i, j]
    for j in range(6):
        for i in range(12):
            out[i, j] += dt * out[i, 6 + j]
    for i in range(6):
        out[i, i] += variance[i] * dt**4 / 4
        out[6 + i, 6 + i] += variance[i] * dt**2
        out[i, 6 + i] += variance[i] * dt**3 / 2
        out[6 + i, i] += variance[i] * dt**3 / 2
    return out


@compiled
def displacement(kinematics: Kinematics, dt: float) -> tuple[Floats, Floats]:
    """Displacement (6,) of a body within `dt` seconds, of either sign, and its velocity (6,) then.

    The acceleration lasts no longer than the interval over which it was observed.
    """
    during = min(max(dt, -kinematics.duration_s), kinematics.duration_s)
    moved = kinematics.velocity * dt + kinematics.acceleration * (during * (dt - during / 2))
    return moved, kinematics.velocity + kinematics.acceleration * during


@compiled
def predicted(state: FilterState, dt: float, variance: Floats) -> FilterState:
    """The state `dt` seconds on, with constant velocity from there: see `MotionState.at`."""
    moved, velocity = displacement(state.kinematics, dt)
    return FilterState(
        rotation_of(moved[3:]) @ state.rotation,
        state.translation + moved[:3],
        Kinematics(velocity, np.zeros(6), 0.0),
        propagated_covariance(state.covariance, dt, variance),
        state.accelerations,
    )


@compiled
def updated(
    state: FilterState,
    dt: float,
    variance: Floats,
    measured_rotation: Floats,
    measured_translation: Floats,
    noise: Floats,
    weight: float,
) -> FilterState:
    """The state after a measured pose.

    Args:
        dt: s from there until the measured pose.
        variance: (6,) configured for the acceleration.
        measured_rotation: (3, 3) of the measured world_from_body.
        measured_translation: (3,) the same.
        noise: (6, 6) covariance of the measured pose.
        weight: of a new acceleration in the moments; 0 to leave them as they are.
    """
    there = predicted(state, dt, _observed_variances(state.accelerations.square, variance))
    innovation = np.empty(6)
    innovation[:3] = measured_translation - there.translation
    innovation[3:] = rotvec_of(measured_rotation @ there.rotation.T)
    step, covariance = kalman_step(there.covariance, noise, innovation)
    accelerations = state.accelerations
    if weight > 0:
        observed = state.kinematics.acceleration + step[6:] / dt
        accelerations = _with_observation(observed, accelerations, weight)
    return FilterState(
        rotation_of(step[3:6]) @ there.rotation,
        there.translation + step[:3],
        Kinematics(
            there.kinematics.velocity + step[6:], _expected_acceleration(accelerations), abs(dt)
        ),
        covariance,
        accelerations,
    )


@compiled
def _with_observation(
    observed: Floats, before: AccelerationMoments, weight: float
) -> AccelerationMoments:
    """The moments with one more acceleration (6,) of a weight."""
    square = before.square + weight * (np.outer(observed, observed) - before.square)
    return AccelerationMoments(
        observed, square, before.product + weight * (observed * before.last - before.product)
    )


@compiled
def _expected_acceleration(moments: AccelerationMoments) -> Floats:
    """The acceleration (6,) to expect: the last one times the autocorrelation in [0, 1]."""
    out = np.zeros(6)
    for i in range(6):
        if moments.square[i, i] > 0:
            observed = moments.product[i] / moments.square[i, i]
            correlation = (observed + _PRIOR_WEIGHT) / (1 + _PRIOR_WEIGHT)
            out[i] = min(max(correlation, 0.0), 1.0) * moments.last[i]
    return out


@compiled
def _observed_variances(square: Floats, variance: Floats) -> Floats:
    """Observed variances (6,) of the acceleration, within bounds relative to the configured."""
    out = variance.copy()
    for i in range(6):
        if square[i, i] > 0:
            low, high = _MIN_VARIANCE_RATIO * variance[i], _MAX_VARIANCE_RATIO * variance[i]
            out[i] = min(max(square[i, i], low), high)
    return out


@compiled
def acceleration_bound(square: Floats, sd: Floats) -> Floats:
    """Standard deviations (6,) of the acceleration: see `MotionState.acceleration_bound`."""
    out = np.empty(6)
    for i in range(6):
        variance = sd[i] * sd[i]
        out[i] = np.sqrt(min(max(square[i, i], variance), _MAX_VARIANCE_RATIO * variance))
    return out


@compiled
def kalman_step(covariance: Floats, noise: Floats, innovation: Floats) -> tuple[Floats, Floats]:
    """The filter's change (12,) of pose and velocity, and the covariance (12, 12) after it.

    Args:
        covariance: (12, 12) of the prediction.
        noise: (6, 6) covariance of the measured pose.
        innovation: (6,) measured minus predicted pose, in the prediction's chart.
    """
    gain = covariance[:, :6].copy() @ inverse(covariance[:6, :6] + noise)
    keep = np.eye(12)
    keep[:, :6] -= gain
    return gain @ innovation, keep @ covariance @ keep.T + gain @ noise @ gain.T
