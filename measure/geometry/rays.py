"""Rays, and cones of rays tangent to spheres: their outlines, exactly.

Rays are taken as whole lines. A camera sees a sphere of radius R at distance D along the unit
vector `a` as the cone of bearings v with `v . a = cos(alpha)`, `sin(alpha) = R / D`. With
w = a / cos(alpha) that reads `v . w = 1`: linear in three unknowns, so the fit needs no start. The
centre of the ellipse in the image is *not* the image of the sphere's centre; the cone's axis is.
(Shiu and Ahmad 1989; the linear form is in notes on the projected sphere, e.g. Zhang, Wong and
Zhang 2007.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

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


@dataclass(frozen=True, eq=False)
class Cone:
    """A right circular cone with its apex at the camera."""

    axis: Floats  # (3,) unit vector towards the sphere's centre
    half_angle: float  # in rad, 0 < half_angle < pi / 2
    # (3, 3) of `axis / cos(half_angle)`, from the bearings' scatter; None if unknown.
    covariance: Floats | None = None

    def center(self, radius_mm: float) -> Floats:
        """Centre (3,) in mm of the sphere of `radius_mm` that this cone is tangent to."""
        return self.axis * (radius_mm / np.sin(self.half_angle))

    def bearings(self, angles: ArrayLike) -> Floats:
        """Unit vectors (n, 3) on the cone at `angles` (n,) in rad around its axis."""
        e1, e2 = _perpendiculars(self.axis)
        phi = np.asarray(angles, dtype=np.float64)[..., None]
        around = np.cos(phi) * e1 + np.sin(phi) * e2
        return np.cos(self.half_angle) * self.axis + np.sin(self.half_angle) * around

    def residuals(self, bearings: Floats) -> Floats:
        """Angles (n,) in rad by which bearings (n, 3) lie outside the cone (negative: inside)."""
        off_axis = np.linalg.norm(np.cross(bearings, self.axis), axis=-1)
        return np.arctan2(off_axis, bearings @ self.axis) - self.half_angle


def tangent_cone(center: ArrayLike, radius_mm: float) -> Cone:
    """The cone from the origin tangent to a sphere at `center` (3,) in mm.

    Raises:
        DegenerateGeometryError: the origin is inside the sphere.
    """
    c = floats("center", center, 3)
    distance = float(np.linalg.norm(c))
    if distance <= radius_mm:
        raise DegenerateGeometryError(
            f"the camera is inside the ball (distance {distance:.1f} mm, radius {radius_mm:.1f} mm)"
        )
    return Cone(c / distance, float(np.arcsin(radius_mm / distance)))


def fit_cone(bearings: ArrayLike, weights: ArrayLike | None = None) -> Cone:
    """Least-squares cone through n >= 3 bearings (n, 3), any arc of the outline.

    Args:
        bearings: (n, 3) directions of outline points, any length; rows with NaN are left out.
        weights: (n,) inverse variances up to a factor; all equal if omitted.

    Raises:
        DegenerateGeometryError: fewer than three bearings, an arc too short, or no such cone.
    """
    v = floats("bearings", bearings, "n", 3)
    root = np.ones(len(v)) if weights is None else np.sqrt(floats("weights", weights, len(v)))
    seen = np.isfinite(v).all(axis=1)
    v, root = v[seen], root[seen]
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    if np.count_nonzero(root) < 3:
        raise DegenerateGeometryError(
            f"a cone needs 3 outline points, got {np.count_nonzero(root)}"
        )
    # The outline is a narrow bundle: solve about its mean, where the system is well conditioned.
    mean = np.average(v, axis=0, weights=root**2)
    mean /= np.linalg.norm(mean)
    frame = np.stack([*_perpendiculars(mean), mean])
    local = v @ frame.T
    scale = float(np.sqrt(np.mean(np.sum(local[:, :2] ** 2, axis=1))))
    design = np.column_stack([local[:, :2] / scale, local[:, 2]]) * root[:, None]
    u, s, vt = np.linalg.svd(design, full_matrices=False)
    if s[-1] < 1e-9 * s[0]:
        raise DegenerateGeometryError(
            f"{len(v)} outline points lie on one line of sight: "
            f"rank {int(np.sum(s > 1e-9 * s[0]))} of 3"
        )
    solution = vt.T @ ((u.T @ root) / s)
    residual = root - design @ solution
    back = frame.T @ np.diag([1 / scale, 1 / scale, 1.0])
    w = back @ solution
    length = float(np.linalg.norm(w))
    if length <= 1.0:
        raise DegenerateGeometryError(
            f"no cone fits the {len(v)} outline points (|w| = {length:.6f} <= 1)"
        )
    spread = float(residual @ residual) / max(len(v) - 3, 1)
    covariance = back @ (vt.T @ np.diag(spread / s**2) @ vt) @ back.T
    return Cone(w / length, float(np.arccos(1.0 / length)), covariance)


def _perpendiculars(axis: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors that complete `axis` (3,) to a right-handed frame (e1, e2, axis)."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    e1 = np.cross(helper, axis)
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(axis, e1)
