"""The shapes of a scene. Rays are intersected with them in `kernels`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.simulation.shading import Material

_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: centre (3,) and radius in mm."""

    center_mm: Floats
    radius_mm: float
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Sphere:
        """The same ball in another frame."""
        return replace(self, center_mm=target_from_source.apply(self.center_mm))

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return np.asarray(self.center_mm, dtype=np.float64)

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        along = directions @ self.anchor / np.linalg.norm(directions, axis=1)
        across = np.sqrt(np.maximum(self.anchor @ self.anchor - along**2, 0))
        return _as_angle(across - self.radius_mm, along)


@dataclass(frozen=True, eq=False)
class Capsule:
    """A rod with round ends: axis from `start_mm` to `end_mm` (3,), radius in mm."""

    start_mm: Floats
    end_mm: Floats
    radius_mm: float
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Capsule:
        """The same rod in another frame."""
        ends = target_from_source.apply(np.stack([self.start_mm, self.end_mm]))
        return replace(self, start_mm=ends[0], end_mm=ends[1])

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return (np.asarray(self.start_mm, dtype=np.float64) + self.end_mm) / 2

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        start = np.asarray(self.start_mm)
        axis = self.end_mm - start
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        # The point of the axis nearest to each line, kept between the ends.
        cosine = unit @ axis
        share = (unit @ start * cosine - start @ axis) / np.maximum(axis @ axis - cosine**2, _TINY)
        near = start + np.clip(share, 0, 1)[:, None] * axis
        along = np.einsum("ij,ij->i", unit, near)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", near, near) - along**2, 0))
        return _as_angle(across - self.radius_mm, along)


@dataclass(frozen=True, eq=False)
class Cuboid:
    """A cuboid; flat ones serve as boards, posters, walls and floors."""

    frame_from_box: RigidTransform  # pose; the cuboid is centred in its own frame
    size_mm: tuple[float, float, float]  # (3,) full edge lengths
    material: Material  # its texture, if any, is evaluated in the box's frame

    def moved(self, target_from_source: RigidTransform) -> Cuboid:
        """The same cuboid in another frame."""
        return replace(self, frame_from_box=target_from_source @ self.frame_from_box)

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return self.frame_from_box.translation

    def clearance(self, directions: Floats) -> Floats:
        """As for a ball, of the bounding ball; -1 everywhere if the camera is inside it."""
        ball = Sphere(self.anchor, float(np.linalg.norm(self.size_mm)) / 2, self.material)
        if np.linalg.norm(self.anchor) <= ball.radius_mm:
            return np.full(len(directions), -1.0)
        return ball.clearance(directions)

    def local(self, points: Floats) -> Floats:
        """Points (n, 3) in the cuboid's own frame."""
        return (points - self.anchor) @ self.frame_from_box.rotation


Shape: TypeAlias = Sphere | Capsule | Cuboid


def _as_angle(gap_mm: Floats, along_mm: Floats) -> Floats:
    """Angles (n,) in rad of distances beside a ray, seen from its origin; inf behind it."""
    return np.where(along_mm > 0, gap_mm / np.maximum(along_mm, _TINY), np.inf)
