"""A constant-velocity Kalman filter on rigid poses.

The error state is the pose's `perturb` chart and its rate; between pictures the body accelerates at
random (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, discrete white-noise acceleration), as
strongly as it did so far. What hands and robots do is less random than that: as far as one
acceleration told the next so far, the last one is expected to go on (an autoregression, as in
Singer 1970, of which the share is learnt).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.tracking.predictive.motion_kernels import (
    Accelerations,
    Course,
    MeasuredPose,
    moved_on,
    possible,
    updated,
)
from measure.model import Motion, Pose

_STEADY_S = 0.3
"""How far back accelerations count: a second or two of shaking has many phases in it."""
_SETTLED = 2
"""Measured poses after which changes of the velocity are the body's, not the filter's start."""
_WILD, _A_MOMENT_S = 4.0, 0.5
"""A body that was lost a moment ago moves faster than it was taken to, or it was not lost."""
_KNOWN = 6
"""The same, after which four of them were seen."""


def steady(velocity: Floats) -> Course:
    """A velocity (6,) that is not expected to change."""
    return Course(velocity, np.zeros(6), 0.0)


def _none_seen() -> Accelerations:
    return Accelerations(np.zeros(6), np.zeros((6, 6)), np.zeros(6))


def per_axis(millimetres: float, radians: float) -> Floats:
    """The same for all axes (6,): of translation, then of rotation."""
    return np.repeat([millimetres, radians], 3)


@dataclass(frozen=True, eq=False)
class MotionState:
    """What is known of the motion at one instant.

    Attributes:
        world_from_body: the pose.
        course: how it moves on.
        time_s: the instant.
        covariance: (12, 12) of the pose's chart and the velocity.
        accelerations: so far.
        measured: number of measured poses it rests on.
    """

    world_from_body: RigidTransform
    course: Course
    time_s: float
    covariance: Floats
    accelerations: Accelerations = field(default_factory=_none_seen)
    measured: int = 0

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
            world_from_body: the pose.
            covariance: (6, 6) of the pose.
            time_s: the instant.
            speed_sd: (6,) its velocity is zero give or take that, mm/s and rad/s.
            acceleration_sd: (6,) to reckon with until some are seen, mm/s^2 and rad/s^2; None for
                what is set.
        """
        full = np.zeros((12, 12))
        full[:6, :6], full[6:, 6:] = covariance, np.diag(speed_sd**2)
        so_far = _none_seen()
        if acceleration_sd is not None:
            so_far = so_far._replace(square=np.diag(acceleration_sd**2))
        return cls(world_from_body, steady(np.zeros(6)), time_s, full, so_far)

    @property
    def new(self) -> bool:
        """Whether the velocity rests on pictures of the instant alone at which it was found."""
        return self.measured < _SETTLED

    @property
    def known(self) -> bool:
        """Whether accelerations enough were seen to tell how strong they are."""
        return self.measured >= _KNOWN

    def possible(self, acceleration_sd: Floats) -> Floats:
        """Standard deviations (6,) of the acceleration to reckon with, mm/s^2 and rad/s^2.

        Args:
            acceleration_sd: (6,) what is set; a body that has shown more may do so again.
        """
        return possible(self.accelerations.square, acceleration_sd)

    def at(self, time_s: float, acceleration_sd: Floats) -> MotionState:
        """The prediction for another instant.

        Args:
            time_s: the instant.
            acceleration_sd: (6,) standard deviation of the acceleration, mm/s^2 and rad/s^2.
        """
        rotation, translation, velocity, covariance = moved_on(
            np.ascontiguousarray(self.world_from_body.rotation),
            np.ascontiguousarray(self.world_from_body.translation),
            self.course,
            self.covariance,
            time_s - self.time_s,
            acceleration_sd**2,
        )
        return MotionState(
            RigidTransform(rotation, translation),
            steady(velocity),
            time_s,
            covariance,
            self.accelerations,
            self.measured,
        )

    def updated(self, pose: Pose, extra: Floats, acceleration_sd: Floats) -> MotionState:
        """The state after a measured pose.

        Args:
            pose: the measurement, at its own time.
            extra: (6,) standard deviations added to its covariance, for what that leaves out.
            acceleration_sd: as in `at`.
        """
        here, seen, dt = self.world_from_body, pose.world_from_body, pose.time_s - self.time_s
        rotation, translation, course, covariance, accelerations = updated(
            np.ascontiguousarray(here.rotation),
            np.ascontiguousarray(here.translation),
            self.course,
            self.covariance,
            dt,
            acceleration_sd**2,
            MeasuredPose(
                np.ascontiguousarray(seen.rotation),
                np.ascontiguousarray(seen.translation),
                pose.covariance,
            ),
            extra**2,
            self.accelerations,
            self._share(dt),
        )
        return MotionState(
            RigidTransform(rotation, translation),
            course,
            pose.time_s,
            covariance,
            accelerations,
            self.measured + 1,
        )

    def _share(self, dt: float) -> float:
        """Of one more acceleration in the mean square of all so far."""
        if self.measured < _SETTLED or dt <= 0:
            return 0.0
        return 1 / min(self.measured - _SETTLED + 1, max(_STEADY_S / dt, 1.0))

    def motion(self, faster: tuple[Floats, Floats] | None = None) -> Motion:
        """As the pipeline hands it to solvers.

        Args:
            faster: by how much (6,) the velocity is known to have changed, and its covariance then.
        """
        change, known = (0.0, self.covariance[6:, 6:]) if faster is None else faster
        return Motion(
            self.world_from_body,
            self.time_s,
            self.course.velocity + change,
            self.covariance[:6, :6],
            velocity_covariance=known,
            acceleration_square=self.accelerations.square,
        )


def just_found(
    world_from_body: RigidTransform,
    covariance: Floats,
    time_s: float,
    speed_sd: Floats,
    acceleration_sd: Floats,
    lost: MotionState | None,
) -> MotionState:
    """The motion of a body just found.

    Args:
        world_from_body: the pose.
        covariance: (6, 6) of the pose.
        time_s: the instant.
        speed_sd: (6,) of a velocity of which nothing is known, mm/s and rad/s.
        acceleration_sd: (6,) what is set, mm/s^2 and rad/s^2.
        lost: the motion when the body was last seen; None if it never was.
    """
    if lost is None or abs(time_s - lost.time_s) > _A_MOMENT_S:
        return MotionState.begin(world_from_body, covariance, time_s, speed_sd)
    wild = _WILD * speed_sd, _WILD * acceleration_sd
    return MotionState.begin(world_from_body, covariance, time_s, *wild)
