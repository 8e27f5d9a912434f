"""Where the body is and how it moves: what tracking knows before it looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.geometry import RigidTransform


@dataclass(frozen=True, eq=False)
class Motion:
    """A pose at a time, with a velocity in the pose's `perturb` chart."""

    world_from_body: RigidTransform  # the pose at `time_s`
    time_s: float  # the instant
    velocity: Floats  # (6,) mm/s and rad/s, both in the world
    covariance: Floats | None = None  # (6, 6) of the pose at `time_s`; None if unknown
    velocity_covariance: Floats | None = None  # (6, 6) of the velocity; None if unknown
    # (6, 6) mean square of the acceleration that `moved` leaves out, in mm/s^2 and rad/s^2; None if
    # it leaves out none, or that is unknown.
    acceleration_square: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", floats("velocity", self.velocity, 6))

    @classmethod
    def at_rest(cls, world_from_body: RigidTransform, time_s: float) -> Motion:
        """A body that does not move."""
        return cls(world_from_body, time_s, np.zeros(6))

    def moved(self, time_s: ArrayLike) -> Floats:
        """How far (..., 6) the body has moved at other times (...), in the chart of the pose."""
        return np.multiply.outer(np.asarray(time_s) - self.time_s, self.velocity)

    def at(self, time_s: float) -> RigidTransform:
        """The pose at another time."""
        if time_s == self.time_s:
            return self.world_from_body
        return self.world_from_body.perturb(self.moved(time_s))
