"""A constant-velocity Kalman filter on rigid poses.

The error state is the pose's `perturb` chart and its rate; the acceleration between images is white
noise (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, discrete white-noise acceleration) with
the variance observed so far. Motions of hands and robots are smoother: successive accelerations are
correlated, and the last one, times their observed autocorrelation, is part of the prediction (an
autoregression, as in Singer 1970).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.geometry import RigidTransform, propagate
from measure.model import Motion, Pose

_PRIOR_WEIGHT = 0.5
"""Weight of a prior autocorrelation of 1, in observed accelerations: a few alone say little."""
_MIN_VARIANCE_RATIO = 1 / 64
"""Least variance of the acceleration, of the configured one: a body at rest may start to move."""
_MAX_VARIANCE_RATIO = 16
"""Largest variance of the acceleration, of the configured one: more counts as an error."""
_TINY = 1e-300  # Least variance that is divided by


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

    def with_observation(self, observed: Floats, weight: float) -> AccelerationMoments:
        """The moments with one more acceleration (6,) of a weight."""
        square = self.square + weight * (np.outer(observed, observed) - self.square)
        product = self.product + weight * (observed * self.last - self.product)
        return AccelerationMoments(observed, square, product)

    def expected(self) -> Floats:
        """The acceleration (6,) to expect: the last one times the autocorrelation in [0, 1]."""
        observed = self.product / np.maximum(self.square.diagonal(), _TINY)
        correlation = (observed + _PRIOR_WEIGHT) / (1 + _PRIOR_WEIGHT)
        return np.clip(correlation, 0.0, 1.0) * self.last

    def variances(self, configured: Floats) -> Floats:
        """Observed variances (6,), within bounds relative to the configured."""
        own = self.square.diagonal()
        low, high = _MIN_VARIANCE_RATIO * configured, _MAX_VARIANCE_RATIO * configured
        return np.where(own > 0, np.clip(own, low, high), configured)


def propagated_covariance(covariance: Floats, dt: ArrayLike, variance: Floats) -> Floats:
    """Covariances (..., 12, 12) of pose and velocity some seconds on: see `MotionState.at`.

    Args:
        covariance: (12, 12).
        dt: (...) s, of either sign.
        variance: (6,) of the acceleration.
    """
    lead = np.asarray(dt, dtype=np.float64)[..., None, None]
    by_acceleration = np.concatenate([lead**2 / 2 * np.eye(6), lead * np.eye(6)], axis=-2)
    return propagate(np.eye(12) + lead * np.eye(12, k=6), covariance) + propagate(
        by_acceleration, np.diag(variance)
    )


def displacement(kinematics: Kinematics, dt: ArrayLike) -> tuple[Floats, Floats]:
    """Displacements (..., 6) of a body within `dt` (...) seconds, and its velocities (..., 6) then.

    The acceleration lasts no longer than the interval over which it was observed.
    """
    lead = np.asarray(dt, dtype=np.float64)[..., None]
    during = np.clip(lead, -kinematics.duration_s, kinematics.duration_s)
    moved = kinematics.velocity * lead + kinematics.acceleration * (during * (lead - during / 2))
    return moved, kinematics.velocity + kinematics.acceleration * during


def kalman_step(covariance: Floats, noise: Floats, innovation: Floats) -> tuple[Floats, Floats]:
    """The filter's change (12,) of pose and velocity, and the covariance (12, 12) after it.

    Args:
        covariance: (12, 12) of the prediction.
        noise: (6, 6) covariance of the measured pose.
        innovation: (6,) measured minus predicted pose, in the prediction's chart.
    """
    gain = covariance[:, :6] @ np.linalg.inv(covariance[:6, :6] + noise)
    keep = np.eye(12)
    keep[:, :6] -= gain
    return gain @ innovation, propagate(keep, covariance) + propagate(gain, noise)


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
        observed, variance = self.accelerations.square.diagonal(), acceleration_sd**2
        return np.sqrt(np.clip(observed, variance, _MAX_VARIANCE_RATIO * variance))

    def at(self, time_s: float, acceleration_sd: Floats) -> MotionState:
        """The prediction for another instant, with constant velocity from there.

        Args:
            acceleration_sd: (6,) mm/s^2 and rad/s^2.
        """
        dt = time_s - self.time_s
        moved, velocity = displacement(self.kinematics, dt)
        return replace(
            self,
            world_from_body=self.world_from_body.perturb(moved),
            kinematics=constant_velocity(velocity),
            time_s=time_s,
            covariance=propagated_covariance(self.covariance, dt, acceleration_sd**2),
        )

    def updated(self, pose: Pose, extra: Floats, acceleration_sd: Floats) -> MotionState:
        """The state after a measured pose.

        Args:
            pose: the measurement, at its own time.
            extra: (6,) standard deviations added to its covariance, for systematic errors.
            acceleration_sd: (6,) configured, mm/s^2 and rad/s^2.
        """
        dt, moments = pose.time_s - self.time_s, self.accelerations
        there = self.at(pose.time_s, np.sqrt(moments.variances(acceleration_sd**2)))
        innovation = pose.world_from_body.difference(there.world_from_body)
        noise = pose.covariance + np.diag(extra**2)
        step, covariance = kalman_step(there.covariance, noise, innovation)
        if (weight := self._observation_weight(dt)) > 0:
            observed = self.kinematics.acceleration + step[6:] / dt
            moments = moments.with_observation(observed, weight)
        velocity = there.kinematics.velocity + step[6:]
        return MotionState(
            there.world_from_body.perturb(step[:6]),
            Kinematics(velocity, moments.expected(), abs(dt)),
            pose.time_s,
            covariance,
            moments,
            self.measured + 1,
        )

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
    speed_sd, acceleration_sd = _LOST_FACTOR * speed_sd, _LOST_FACTOR * acceleration_sd
    return MotionState.begin(world_from_body, covariance, time_s, speed_sd, acceleration_sd)
