"""A constant-velocity Kalman filter on rigid poses.

The error state is the pose's `perturb` chart and its rate; the acceleration between images is white
noise (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, discrete white-noise acceleration) with
the variance observed so far. Motions of hands and robots are smoother: successive accelerations are
correlated, and the last one, times their observed autocorrelation, is part of the prediction (an
autoregression, as in Singer 1970).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.tracking.predictive.motion_kernels import (
    AccelerationMoments,
    FilterState,
    Kinematics,
    acceleration_bound,
    predicted,
    updated,
)
from measure.model import Motion, Pose

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
