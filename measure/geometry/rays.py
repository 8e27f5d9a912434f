"""Rays, taken as whole lines: the point nearest to them, and pairs that are far from parallel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints, floats
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


def usable_pairs(rays: Rays, min_angle_rad: float = MIN_PARALLAX_RAD) -> Ints:
    """Pairs (p, 2) of n lines that meet at `min_angle_rad` or more, either way round.

    Raises:
        DegenerateGeometryError: there is none.
    """
    pairs = np.stack(np.triu_indices(len(rays.directions), k=1), axis=1).astype(np.int64)
    first, second = rays.directions[pairs[:, 0]], rays.directions[pairs[:, 1]]
    sines = np.linalg.norm(np.cross(first, second), axis=1)
    good = sines >= max(np.sin(min_angle_rad), MIN_PARALLAX_RAD)
    if not np.any(good):
        raise DegenerateGeometryError(
            f"none of {len(pairs)} pairs of rays meets at {np.degrees(min_angle_rad):.2f} deg or "
            f"more (widest {np.degrees(np.arcsin(min(sines.max(initial=0.0), 1.0))):.3f} deg)"
        )
    return pairs[good]
