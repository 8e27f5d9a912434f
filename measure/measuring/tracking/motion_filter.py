"""A constant-velocity Kalman filter on rigid poses.

The error state is the pose's `perturb` chart and its rate; between pictures the body accelerates at
random (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, discrete white-noise acceleration).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Motion, Pose


@dataclass(frozen=True, eq=False)
class MotionState:
    """What is known of the motion at one instant.

    Attributes:
        world_from_body: the pose.
        velocity: (6,) mm/s and rad/s in the world.
        time_s: the instant.
        covariance: (12, 12) of the pose's chart and the velocity.
    """

    world_from_body: RigidTransform
    velocity: Floats
    time_s: float
    covariance: Floats

    @classmethod
    def begin(
        cls,
        world_from_body: RigidTransform,
        covariance: Floats,
        time_s: float,
        speed_sd: Floats,
    ) -> MotionState:
        """A body just found: its velocity is zero give or take `speed_sd` (6,)."""
        full = np.zeros((12, 12))
        full[:6, :6], full[6:, 6:] = covariance, np.diag(speed_sd**2)
        return cls(world_from_body, np.zeros(6), time_s, full)

    def at(self, time_s: float, acceleration_sd: Floats) -> MotionState:
        """The prediction for another instant.

        Args:
            time_s: the instant.
            acceleration_sd: (6,) standard deviation of the acceleration, mm/s^2 and rad/s^2.
        """
        dt = time_s - self.time_s
        step = np.eye(12)
        step[:6, 6:] = dt * np.eye(6)
        covariance = step @ self.covariance @ step.T
        variance = acceleration_sd**2
        index = np.arange(6)
        covariance[index, index] += variance * dt**4 / 4
        covariance[index + 6, index + 6] += variance * dt**2
        covariance[index, index + 6] += variance * abs(dt) ** 3 / 2
        covariance[index + 6, index] += variance * abs(dt) ** 3 / 2
        moved = self.world_from_body.perturb(self.velocity * dt)
        return MotionState(moved, self.velocity, time_s, covariance)

    def updated(self, pose: Pose, extra: Floats, acceleration_sd: Floats) -> MotionState:
        """The state after a measured pose.

        Args:
            pose: the measurement, at its own time.
            extra: (6,) standard deviations added to its covariance, for what that leaves out.
            acceleration_sd: as in `at`.
        """
        predicted = self.at(pose.time_s, acceleration_sd)
        noise = pose.covariance + np.diag(extra**2)
        gain = np.linalg.solve(predicted.covariance[:6, :6] + noise, predicted.covariance[:6]).T
        step = gain @ pose.world_from_body.difference(predicted.world_from_body)
        keep = np.eye(12)
        keep[:, :6] -= gain
        covariance = keep @ predicted.covariance @ keep.T + gain @ noise @ gain.T
        return MotionState(
            predicted.world_from_body.perturb(step[:6]),
            predicted.velocity + step[6:],
            pose.time_s,
            covariance,
        )

    def motion(self) -> Motion:
        """As the pipeline hands it to solvers."""
        return Motion(
            self.world_from_body,
            self.time_s,
            self.velocity,
            self.covariance[:6, :6],
            velocity_covariance=self.covariance[6:, 6:],
        )
