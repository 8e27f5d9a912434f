"""A robot's states over time."""

from __future__ import annotations

from dataclasses import dataclass

from measure.arrays import Floats, floats
from measure.robots.schema import StateSchema


@dataclass(frozen=True, eq=False)
class RobotLog:
    """States of one robot on the robot's own clock.

    Attributes:
        schema: what the columns of `states` are.
        times_s: (n,) strictly increasing.
        states: (n, features).
    """

    schema: StateSchema
    times_s: Floats
    states: Floats

    def __post_init__(self) -> None:
        count = len(floats("times_s", self.times_s, "n"))
        floats("states", self.states, count, len(self.schema.features))
