"""A constant-velocity Kalman filter on rigid poses.

The error state is the pose's `perturb` chart and its rate; the acceleration between images is white
noise (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, discrete white-noise acceleration) with
the variance observed so far. Motions of hands and robots are smoother: successive accelerations are
correlated, and the last one, times their observed autocorrelation, is part of the prediction (an
autoregression, as in Singer 1970).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry import RigidTransform
from measure.geometry.linear_kernels import inverse
from measure.geometry.rotation_kernels import rotation_of, rotvec_of
from measure.model import Motion, Pose

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


_MEMORY_S = 0.3  # Time constant of the mean over accelerations
_MIN_POSES_VELOCITY = 2
"""Measured poses after which changes of the velocity are the body's, not the filter's start."""
_MIN_POSES_ACCELERATION = 6  # Measured poses after which four accelerations have been observed
_LOST_FACTOR, _LOST_S = 4.0, 0.5
"""Factor on speed and acceleration of a body found again within so many seconds after its loss."""


def constant_velocity(velocity: Floats) -> Kinematics:
    """A velocity (6,) without acceleration."""
    return Kinematics(velocity, np.zeros(6), 0.0)


def _none_observed() -> AccelerationMoments:
    return AccelerationMoments(np.zeros(6), np.zeros((6, 6)), np.zeros(6))


def per_axis(millimetres: float, radians: float) -> Floats:
    """The same value for all axes (6,): of translation, then of rotation."""
    return np.repeat([millimetres, radians], 3)


@dataclass(frozen=True, eq=False)
class MotionState:
    """Pose and motion at one instant."""

    world_from_body: RigidTransform
    kinematics: Kinematics
    time_s: float
    covariance: Floats  # (12, 12) of the pose's chart and the velocity
    accelerations: AccelerationMoments = field(default_factory=_none_observed)  # observed so far
    measured: int = 0  # number of measured poses it rests on

    @classmethod
    def begin(
        cls,
        world_from_body: RigidTransform,
        covariance: Floats,
        time_s: float,
        speed_sd: Floats,
        acceleration_sd: Floats | None = None,
    ) -> MotionState:
        """A body just found.

        Args:
            covariance: (6, 6) of the pose.
            speed_sd: (6,) standard deviation of its velocity about zero, mm/s and rad/s.
            acceleration_sd: (6,) assumed until some are observed, mm/s^2 and rad/s^2; None for the
                configured ones.
        """
        full = np.zeros((12, 12))
        full[:6, :6], full[6:, 6:] = covariance, np.diag(speed_sd**2)
        moments = _none_observed()
        if acceleration_sd is not None:
            moments = moments._replace(square=np.diag(acceleration_sd**2))
        return cls(world_from_body, constant_velocity(np.zeros(6)), time_s, full, moments)

    @property
    def new(self) -> bool:
        """Whether the velocity rests on no images but those in which the body was found."""
        return self.measured < _MIN_POSES_VELOCITY

    @property
    def accelerations_known(self) -> bool:
        """Whether enough accelerations were observed to know their variance."""
        return self.measured >= _MIN_POSES_ACCELERATION

    def acceleration_bound(self, acceleration_sd: Floats) -> Floats:
        """Standard deviations (6,) of the acceleration to assume, mm/s^2 and rad/s^2.

        Args:
            acceleration_sd: (6,) configured; the observed ones count where they are larger.
        """
        return acceleration_bound(self.accelerations.square, acceleration_sd)

    def at(self, time_s: float, acceleration_sd: Floats) -> MotionState:
        """The prediction for another instant; (6,) sd of the acceleration in mm/s^2 and rad/s^2."""
        state = predicted(self.filter_state(), time_s - self.time_s, acceleration_sd**2)
        return self._with(state, time_s, self.measured)

    def updated(self, pose: Pose, extra: Floats, acceleration_sd: Floats) -> MotionState:
        """The state after a measured pose.

        Args:
            pose: the measurement, at its own time.
            extra: (6,) standard deviations added to its covariance, for systematic errors.
            acceleration_sd: (6,) configured, mm/s^2 and rad/s^2.
        """
        measured, dt = pose.world_from_body, pose.time_s - self.time_s
        state = updated(
            self.filter_state(),
            dt,
            acceleration_sd**2,
            np.ascontiguousarray(measured.rotation),
            np.ascontiguousarray(measured.translation),
            pose.covariance + np.diag(extra**2),
            self._observation_weight(dt),
        )
        return self._with(state, pose.time_s, self.measured + 1)

    def filter_state(self) -> FilterState:
        """The same for compiled code, without the time."""
        return FilterState(
            np.ascontiguousarray(self.world_from_body.rotation),
            np.ascontiguousarray(self.world_from_body.translation),
            self.kinematics,
            self.covariance,
            self.accelerations,
        )

    def _with(self, state: FilterState, time_s: float, measured: int) -> MotionState:
        rotation, translation, kinematics, covariance, accelerations = state
        pose = RigidTransform(rotation, translation)
        return MotionState(pose, kinematics, time_s, covariance, accelerations, measured)

    def _observation_weight(self, dt: float) -> float:
        """Weight of one more acceleration in the moments: 1 / n, then that of the time constant."""
        if self.measured < _MIN_POSES_VELOCITY or dt <= 0:
            return 0.0
        return 1 / min(self.measured - _MIN_POSES_VELOCITY + 1, max(_MEMORY_S / dt, 1.0))

    def motion(self, velocity_change: tuple[Floats, Floats] | None = None) -> Motion:
        """For pose solvers: (6,) change of velocity by newer detections, with its covariance."""
        change, covariance = velocity_change or (0.0, self.covariance[6:, 6:])
        return Motion(
            self.world_from_body,
            self.time_s,
            self.kinematics.velocity + change,
            self.covariance[:6, :6],
            velocity_covariance=covariance,
            acceleration_square=self.accelerations.square,
        )


def initial_state(
    world_from_body: RigidTransform,
    covariance: Floats,
    time_s: float,
    speed_sd: Floats,
    acceleration_sd: Floats,
    lost: MotionState | None,
) -> MotionState:
    """The motion of a body just found; faster than usual if it was lost shortly before.

    Args:
        covariance: (6, 6) of the pose.
        speed_sd: (6,) standard deviation of an unknown velocity, mm/s and rad/s.
        acceleration_sd: (6,) configured, mm/s^2 and rad/s^2.
        lost: the motion when the body was last measured; None if it never was.
    """
    if lost is None or abs(time_s - lost.time_s) > _LOST_S:
        return MotionState.begin(world_from_body, covariance, time_s, speed_sd)
    faster = _LOST_FACTOR * speed_sd, _LOST_FACTOR * acceleration_sd
    return MotionState.begin(world_from_body, covariance, time_s, *faster)
