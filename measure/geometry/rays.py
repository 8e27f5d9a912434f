"""Rays (half-lines seen as lines) and the points nearest to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import DegenerateGeometryError

MIN_PARALLAX_RAD = 1e-4
"""Rays closer to parallel than this have no usable intersection (0.1 mm in 1 m)."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Lines `origin + s direction`.

    Attributes:
        origins: (..., 3) in mm.
        directions: (..., 3), unit length (normalised on construction); NaN where there is no ray.

    Raises:
        DegenerateGeometryError: a direction has no length.
    """

    origins: Floats
    directions: Floats

    def __post_init__(self) -> None:
        origins = floats("origins", self.origins, "...", 3)
        directions = floats("directions", self.directions, "...", 3)
        norms = np.linalg.norm(directions, axis=-1, keepdims=True)
        if np.any(norms == 0):
            raise DegenerateGeometryError(
                f"{np.count_nonzero(norms == 0)} of {norms.size} rays have a direction of length 0"
            )
        object.__setattr__(self, "origins", origins)
        object.__setattr__(self, "directions", directions / norms)

    def distances(self, points: Floats) -> Floats:
        """Perpendicular distances (...) in mm of points (..., 3) from the lines."""
        return np.linalg.norm(np.cross(points - self.origins, self.directions), axis=-1)


def common_perpendicular(rays: Rays) -> tuple[Floats, float]:
    """The two feet (2, 3) of the common perpendicular of two lines, and its length in mm.

    Raises:
        DegenerateGeometryError: the lines are parallel.
    """
    (o1, o2), (d1, d2) = rays.origins, rays.directions
    normal = np.cross(d1, d2)
    sine2 = float(normal @ normal)
    if sine2 < MIN_PARALLAX_RAD**2:
        raise DegenerateGeometryError(
            f"two rays are parallel within {np.sqrt(sine2):.1e} rad: they do not meet in one point"
        )
    between = o2 - o1
    foot1 = o1 + d1 * (np.cross(between, d2) @ normal / sine2)
    foot2 = o2 + d2 * (np.cross(between, d1) @ normal / sine2)
    return np.stack([foot1, foot2]), float(np.linalg.norm(foot2 - foot1))


def nearest_point(rays: Rays, weights: Floats | None = None) -> Floats:
    """The point (3,) with the least (weighted) sum of squared distances from n >= 2 lines.

    Raises:
        DegenerateGeometryError: fewer than two lines, or all of them parallel.
    """
    d = rays.directions
    if len(d) < 2:
        raise DegenerateGeometryError(f"a point needs 2 rays, got {len(d)}")
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    if weights is not None:
        across = across * weights[:, None, None]
    normal = across.sum(axis=0)
    spread = np.linalg.eigvalsh(normal)
    if spread[0] < spread[2] * MIN_PARALLAX_RAD**2:
        raise DegenerateGeometryError(
            f"{len(d)} rays are parallel: their nearest point is undetermined along them"
        )
    return np.linalg.solve(normal, np.einsum("nij,nj->i", across, rays.origins))
