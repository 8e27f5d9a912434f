"""The body: the rigid thing that is measured, known by its balls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import DegenerateGeometryError
from measure.model.color import BallColor

USUAL_RADIUS_TOLERANCE_MM = 0.05
COMMON_RADIUS_VARIANCE = 0.5
"""Share of the radii's variance that balls of one make and paint have in common."""
MIN_BREADTH_RATIO = 0.02
"""Balls whose second extent is below this share of the first count as collinear."""


@dataclass(frozen=True, eq=False)
class Ball:
    """One ball."""

    name: str  # unique within the body
    color: BallColor  # how its pixels are recognised
    center_mm: Floats  # (3,) in the body frame
    radius_mm: float  # of the sphere

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "center_mm", floats(f"ball {self.name}: center_mm", self.center_mm, 3)
        )
        if not np.isfinite(self.center_mm).all():
            raise ValueError(f"ball {self.name}: center_mm must be finite, got {self.center_mm}")
        if not 0 < self.radius_mm < np.inf:
            raise ValueError(f"ball {self.name}: radius_mm must be positive, got {self.radius_mm}")


@dataclass(frozen=True, eq=False)
class Body:
    """At least three balls, each with a name of its own, not on one line.

    Attributes:
        name: of the body.
        balls: where they should be.
        tolerance_mm: standard deviation of each coordinate of where they are; 0 is exact.
        radius_tolerance_mm: standard deviation of each radius; 0 is exact.
        measured_radii: covariance (k, k) in mm^2 of radii that were measured; None if they are as
            `radius_tolerance_mm` says.

    Raises:
        DegenerateGeometryError: fewer than three balls, or collinear ones.
        ValueError: two balls have one name, or a tolerance is none.
    """

    name: str
    balls: tuple[Ball, ...]
    tolerance_mm: float = 0.0
    radius_tolerance_mm: float = USUAL_RADIUS_TOLERANCE_MM
    measured_radii: Floats | None = None

    def __post_init__(self) -> None:
        if len(self.balls) < 3:
            raise DegenerateGeometryError(
                f"body '{self.name}' has {len(self.balls)} balls: a pose needs at least 3"
            )
        if not 0 <= self.tolerance_mm < np.inf:
            raise ValueError(f"body '{self.name}': tolerance_mm must be 0 or more")
        if not 0 <= self.radius_tolerance_mm < np.inf:
            raise ValueError(f"body '{self.name}': radius_tolerance_mm must be 0 or more")
        if twice := {name for name in self.names if self.names.count(name) > 1}:
            names = " and ".join(f"'{name}'" for name in sorted(twice))
            raise ValueError(f"body '{self.name}': more than one ball is called {names}")
        spread = np.linalg.svd(self.centers - self.centers.mean(axis=0), compute_uv=False)
        if spread[1] < MIN_BREADTH_RATIO * spread[0]:
            raise DegenerateGeometryError(
                f"body '{self.name}': the balls lie on one line "
                f"(extents {spread[0]:.1f} and {spread[1]:.2f} mm), "
                "so a turn about it cannot be seen; move one ball off the line"
            )

    def with_centers(self, centers: Floats) -> Body:
        """The same balls at (k, 3) mm."""
        moved = zip(self.balls, centers, strict=True)
        return replace(self, balls=tuple(replace(ball, center_mm=at) for ball, at in moved))

    def with_radii(self, radii: Floats, covariance: Floats) -> Body:
        """The same balls with measured radii (k,) mm and their covariance (k, k) mm^2."""
        sized = zip(self.balls, radii.tolist(), strict=True)
        balls = tuple(replace(ball, radius_mm=radius) for ball, radius in sized)
        return replace(self, balls=balls, measured_radii=covariance)

    @cached_property
    def centers(self) -> Floats:
        """Ball centres (k, 3) in the body frame, mm."""
        return np.stack([ball.center_mm for ball in self.balls])

    @cached_property
    def middle(self) -> Floats:
        """Mean of the balls' centres (3,), mm; the origin may lie anywhere."""
        return np.mean(self.centers, axis=0)

    @cached_property
    def radii(self) -> Floats:
        """Ball radii (k,) in mm."""
        return np.array([ball.radius_mm for ball in self.balls])

    @cached_property
    def radius_covariance(self) -> Floats:
        """Covariance (k, k) in mm^2 of the radii: as measured, or by their tolerance."""
        if self.measured_radii is not None:
            return self.measured_radii
        alike, k = COMMON_RADIUS_VARIANCE, len(self.balls)
        return self.radius_tolerance_mm**2 * ((1 - alike) * np.eye(k) + alike)

    @cached_property
    def center_covariance(self) -> Floats:
        """Covariance (3, 3) in mm^2 of a ball's centre in the body frame, by the tolerance."""
        return self.tolerance_mm**2 * np.eye(3)

    @cached_property
    def distance_sd_mm(self) -> float:
        """Standard deviation of the distance between two balls, by the tolerance."""
        return math.sqrt(2) * self.tolerance_mm

    @cached_property
    def reach_mm(self) -> float:
        """Distance of the furthest ball's centre from the body's origin, mm."""
        return float(np.max(np.linalg.norm(self.centers, axis=1)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Ball names, in order."""
        return tuple(ball.name for ball in self.balls)

    def index(self, name: str) -> int:
        """Position of the ball called `name`."""
        return self._places[name]

    def centers_of(self, names: Sequence[str]) -> Floats:
        """Centres (n, 3) of the balls called `names` in the body frame, mm; not to be changed."""
        if tuple(names) == self.names:
            return self.centers
        return self.centers[[self.index(name) for name in names]]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def distances(self) -> dict[tuple[str, str], float]:
        """Centre-to-centre distance in mm of every pair of balls."""
        return {
            (a.name, b.name): float(np.linalg.norm(a.center_mm - b.center_mm))
            for i, a in enumerate(self.balls)
            for b in self.balls[i + 1 :]
        }


def paper_body() -> Body:
    """The body of the paper: three balls of radius 20 mm, 38 mm from the end effector."""
    places = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-38.0, 0.0, 0.0)}
    balls = tuple(Ball(n, BallColor.named(n), np.array(c), 20.0) for n, c in places.items())
    return Body("raven three-ball body", balls)
