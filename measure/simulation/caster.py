"""Casting rays: which shape each pixel sees, exactly at the edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.simulation.shading import Lighting, Surface, shade
from measure.simulation.shapes import Box, Shape, Sphere

NOTHING = -1
_GOLDEN = (np.sqrt(5) - 1) / 2
_EDGE_PX = 0.75
"""An outline crosses a pixel only if it passes its centre nearer than this."""


@dataclass(frozen=True, eq=False)
class Stage:
    """Shapes and light, in a camera's frame.

    Attributes:
        shapes: in the camera's frame.
        lighting: in the camera's frame.
        focal_px: of the camera, to tell how many pixels an angle is.
        velocities: (k, 3) mm/s of the shapes, for a rolling shutter; None if all stand still.
        longest_delay_s: of any row, before or after the middle one.
    """

    shapes: tuple[Shape, ...]
    lighting: Lighting
    focal_px: float
    velocities: Floats | None = None
    longest_delay_s: float = 0.0

    def trace(
        self, ideal: Floats, near: Bools, delays_s: Floats | None = None
    ) -> tuple[Ints, Floats]:
        """What rays hit first.

        Args:
            ideal: (n, 2) undistorted normalised image coordinates.
            near: (k, n) which shapes a ray may meet.
            delays_s: (n,) when each ray is cast, relative to the time the shapes are given for.

        Returns:
            Index of the shape (n,), `NOTHING` for none; and the depth (n,).
        """
        directions = np.column_stack([ideal, np.ones(len(ideal))])
        first, depth = np.full(len(ideal), NOTHING), np.full(len(ideal), np.inf)
        for k, shape in enumerate(self.shapes):
            rows = np.flatnonzero(near[k])
            if not rows.size:
                continue
            d = shape.cast(self._origins(k, delays_s, rows), directions[rows])
            closer = d < depth[rows]
            depth[rows[closer]], first[rows[closer]] = d[closer], k
        return first, depth

    def colours(
        self, ideal: Floats, first: Ints, depth: Floats, delays_s: Floats | None = None
    ) -> Floats:
        """Linear radiance (n, 3), B G R, of what `trace` found; 0 where nothing."""
        out = np.zeros((len(ideal), 3))
        balls = [s for s in self.shapes if isinstance(s, Sphere)] if self.lighting.shadows else []
        for k, shape in enumerate(self.shapes):
            rows = np.flatnonzero(first == k)
            if not rows.size:
                continue
            points = depth[rows, None] * np.column_stack([ideal[rows], np.ones(rows.size)])
            points = points + self._origins(k, delays_s, rows)
            surface = Surface(
                points, shape.normals(points), shape.albedo(points)[..., ::-1], shape.material
            )
            blockers = tuple((b.anchor, b.radius_mm) for b in balls if b is not shape)
            out[rows] = shade(surface, self.lighting, blockers)
        return out

    def gaps_px(self, k: int, ideal: Floats) -> Floats:
        """How far (n,) in px rays pass the silhouette of shape k; negative inside."""
        directions = np.column_stack([ideal, np.ones(len(ideal))])
        length2 = np.einsum("ij,ij->i", directions, directions)
        # One radian is f px on the axis and f / cos^2 off it.
        return self.shapes[k].clearance(directions) * self.focal_px * length2

    def silhouettes(self, ideal: Floats, near: Bools) -> Bools:
        """Whether the outline of a round shape crosses the pixel of each ray (n,)."""
        found = np.zeros(len(ideal), bool)
        for k, shape in enumerate(self.shapes):
            if isinstance(shape, Box):
                continue
            rows = np.flatnonzero(near[k])
            found[rows] |= np.abs(self.gaps_px(k, ideal[rows])) < _EDGE_PX + self.smear_px(k)
        return found

    def smear_px(self, k: int) -> float:
        """How far a rolling shutter may move shape k's outline."""
        if self.velocities is None or self.longest_delay_s == 0:
            return 0.0
        shape = self.shapes[k]
        speed = np.linalg.norm(self.velocities[k]) / np.linalg.norm(shape.anchor)
        return float(speed) * self.longest_delay_s * self.focal_px

    def _origins(self, k: int, delays_s: Floats | None, rows: Ints) -> Floats:
        """Where rays start in the frame that moves along with shape k."""
        if delays_s is None or self.velocities is None:
            return np.zeros(3)
        return -np.multiply.outer(delays_s[rows], self.velocities[k])


def spread(count: int) -> Floats:
    """Offsets (count, 2) in px within a pixel: the golden-ratio lattice.

    89 of them give the area beside a straight edge to 0.009 px RMS at any slant; every offset
    differs from all others in both coordinates, so edges along rows and columns do as well.
    """
    i = np.arange(count)
    return np.column_stack([(i + 0.5) / count, (i * _GOLDEN + 0.5 / count) % 1]) - 0.5
