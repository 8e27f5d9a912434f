"""The solid things of a scene, and where rays meet them, in closed form.

A ray is `origin + t * direction` with `direction = (x, y, 1)` in the camera frame, so that `t` is
the depth. Origins are (3,) or (n, 3): a shape that moves while a rolling shutter runs is met by
rays that start elsewhere.
"""

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

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Depths (n,) where rays enter; inf where they miss."""
        return _enter_sphere(self.anchor - origins, self.radius_mm, directions)

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        along = directions @ self.anchor / np.linalg.norm(directions, axis=1)
        across = np.sqrt(np.maximum(self.anchor @ self.anchor - along**2, 0))
        return _as_angle(across - self.radius_mm, along)

    def normals(self, points: Floats) -> Floats:
        """Outward unit normals (n, 3) at surface points (n, 3)."""
        return (points - self.anchor) / self.radius_mm

    def albedo(self, points: Floats) -> Floats:  # noqa: ARG002 - one colour all over
        """Diffuse reflectance, R G B."""
        return np.array(self.material.albedo_rgb)


@dataclass(frozen=True, eq=False)
class Capsule:
    """A rod with round ends: axis from `start_mm` to `end_mm` (3,), radius in mm."""

    start_mm: Floats
    end_mm: Floats
    radius_mm: float
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Capsule:
        """The same rod in another frame."""
        return replace(
            self,
            start_mm=target_from_source.apply(self.start_mm),
            end_mm=target_from_source.apply(self.end_mm),
        )

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return (np.asarray(self.start_mm, dtype=np.float64) + self.end_mm) / 2

    @property
    def _axis(self) -> Floats:
        return np.asarray(self.end_mm, dtype=np.float64) - self.start_mm

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Depths (n,) where rays enter; inf where they miss."""
        axis = self._axis
        length2 = float(axis @ axis)
        apart = self.start_mm - origins
        d_axis, a_axis = directions @ axis / length2, _dot_axis(apart, axis) / length2
        d_across = directions - d_axis[:, None] * axis
        a_across = apart - np.multiply.outer(a_axis, axis)
        depth = _enter_sphere(a_across, self.radius_mm, d_across)
        with np.errstate(invalid="ignore"):
            where = depth * d_axis - a_axis
        out = np.where((where >= 0) & (where <= 1), depth, np.inf)
        for end in (self.start_mm, self.end_mm):
            out = np.minimum(out, _enter_sphere(end - origins, self.radius_mm, directions))
        return out

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        axis, start = self._axis, np.asarray(self.start_mm)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        # The point of the axis nearest to each line, kept between the ends.
        cosine = unit @ axis
        share = (unit @ start * cosine - start @ axis) / np.maximum(axis @ axis - cosine**2, _TINY)
        near = start + np.clip(share, 0, 1)[:, None] * axis
        along = np.einsum("ij,ij->i", unit, near)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", near, near) - along**2, 0))
        return _as_angle(across - self.radius_mm, along)

    def normals(self, points: Floats) -> Floats:
        """Outward unit normals (n, 3) at surface points (n, 3)."""
        axis = self._axis
        share = np.clip((points - self.start_mm) @ axis / (axis @ axis), 0, 1)
        out = points - self.start_mm - share[:, None] * axis
        return out / np.linalg.norm(out, axis=1, keepdims=True)

    def albedo(self, points: Floats) -> Floats:  # noqa: ARG002 - one colour all over
        """Diffuse reflectance, R G B."""
        return np.array(self.material.albedo_rgb)


@dataclass(frozen=True, eq=False)
class Box:
    """A block; flat ones serve as boards, posters, walls and floors.

    Attributes:
        frame_from_box: pose; the box is centred in its own frame.
        size_mm: (3,) full edge lengths.
        material: its texture, if any, is evaluated in the box's frame.
    """

    frame_from_box: RigidTransform
    size_mm: tuple[float, float, float]
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Box:
        """The same block in another frame."""
        return replace(self, frame_from_box=target_from_source @ self.frame_from_box)

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return self.frame_from_box.translation

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Depths (n,) where rays enter; inf where they miss."""
        into = self.frame_from_box.rotation
        start, along = (origins - self.anchor) @ into, directions @ into
        along = np.where(np.abs(along) < _TINY, _TINY, along)
        half = np.array(self.size_mm) / 2
        first, second = (-half - start) / along, (half - start) / along
        enter = np.minimum(first, second).max(axis=1)
        leave = np.maximum(first, second).min(axis=1)
        return np.where((enter < leave) & (enter > 0), enter, np.inf)

    def clearance(self, directions: Floats) -> Floats:
        """The same for the box's bounding ball; -1 everywhere if the camera is inside that."""
        ball = Sphere(self.anchor, float(np.linalg.norm(self.size_mm)) / 2, self.material)
        if np.linalg.norm(self.anchor) <= ball.radius_mm:
            return np.full(len(directions), -1.0)
        return ball.clearance(directions)

    def normals(self, points: Floats) -> Floats:
        """Outward unit normals (n, 3) at surface points (n, 3)."""
        local = self._local(points) / (np.array(self.size_mm) / 2)
        face = np.argmax(np.abs(local), axis=1)
        rows = np.arange(len(local))
        return self.frame_from_box.rotation.T[face] * np.sign(local[rows, face])[:, None]

    def albedo(self, points: Floats) -> Floats:
        """Diffuse reflectance (n, 3) or (3,), R G B."""
        if self.material.texture is None:
            return np.array(self.material.albedo_rgb)
        return self.material.texture(self._local(points))

    def _local(self, points: Floats) -> Floats:
        return (points - self.anchor) @ self.frame_from_box.rotation


Shape: TypeAlias = Sphere | Capsule | Box


def _enter_sphere(apart: Floats, radius: float, directions: Floats) -> Floats:
    """Depths (n,) where rays from the origin enter a sphere centred `apart`; inf if missed."""
    a = np.einsum("ij,ij->i", directions, directions)
    b = _dot(directions, apart)
    inside = b * b - a * (np.sum(apart * apart, axis=-1) - radius**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (b - np.sqrt(inside)) / a
    return np.where((inside > 0) & (depth > 0), depth, np.inf)


def _as_angle(gap_mm: Floats, along_mm: Floats) -> Floats:
    """Gaps beside a ray, seen from its origin; inf behind it."""
    return np.where(along_mm > 0, gap_mm / np.maximum(along_mm, _TINY), np.inf)


def _dot(directions: Floats, apart: Floats) -> Floats:
    """Row-wise products of (n, 3) with (3,) or (n, 3)."""
    return directions @ apart if apart.ndim == 1 else np.einsum("ij,ij->i", directions, apart)


def _dot_axis(apart: Floats, axis: Floats) -> Floats:
    """Products of (3,) or (n, 3) with an axis (3,), as an array that broadcasts over rays."""
    return np.atleast_1d(apart @ axis)
