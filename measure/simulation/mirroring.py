"""Mirror images on glossy surfaces: one reflection, traced to all other shapes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from measure.arrays import Floats, Ints
from measure.simulation.kernels import BOX, KIND, REFLECTANCE, ROUGHNESS
from measure.simulation.light_kernels import Lights, shine
from measure.simulation.mirror_grids import Grid, grid_of, interpolated
from measure.simulation.mirror_kernels import count_facets, mean_of_facets, trace_mirrored
from measure.simulation.surface_kernels import REUSE, Points, no_points

_FACETS = 32.0
"""Facets of a rough surface that mirror rays for one pixel, where all light is mirrored."""
_SOFT_RAD = 0.04
"""On balls and rods rougher than this, the mirror image is interpolated on a grid."""
_GRID_FACETS, _FEWEST_GRID_FACETS = 32.0, 8.0


class Mirror:
    """The mirror images on the shapes of a stage.

    Args:
        shapes: (k, ROW).
        albedo_of: reflectance (m, 3), B G R, of shapes (m,) at places (m, 3) after delays (m,).
        part: (index, count) of the stages that are averaged; each traces its share of the facets.
    """

    def __init__(
        self,
        shapes: Floats,
        lights: Lights,
        albedo_of: Callable[[Ints, Floats, Floats], Floats],
        part: tuple[int, int],
    ) -> None:
        self._shapes, self._lights, self._albedo_of = shapes, lights, albedo_of
        self._part, self._parts = part
        self._images: dict[int, tuple[Grid, Floats]] = {}
        soft = (shapes[:, ROUGHNESS] > _SOFT_RAD) & (shapes[:, REFLECTANCE] > 0)
        self._soft = [int(k) for k in np.flatnonzero(soft & (shapes[:, KIND] != BOX))]

    def radiance(self, points: Points, numbers: Ints, per_pixel: int) -> Floats:
        """Radiance (n, 3) that points mirror to their viewers, without lamps, B G R.

        Args:
            points: (n,) the points.
            numbers: (n,) index of each point in its pixel.
            per_pixel: rays through a pixel.
        """
        out, left = np.zeros((len(points.shape), 3)), self._shapes[points.shape, REFLECTANCE] > 0
        for k in self._soft:
            rows = np.flatnonzero(points.shape == k)
            grid, image = self._image(k, rows.size)
            if grid is not None:
                where, covered = grid.coordinates(_some(points, rows))
                out[rows[covered]] = interpolated(image, where[covered])
                left[rows[covered]] = False
        rows, most = np.flatnonzero(left), _FACETS / -(-per_pixel // REUSE)
        if rows.size:
            out[rows] = self._traced(_some(points, rows), numbers[rows], most, 0.0)
        return out

    def _image(self, k: int, count: int) -> tuple[Grid | None, Floats]:
        """Grid of shape k and its mirror image; none for fewer points than the grid has nodes."""
        if k not in self._images:
            grid = grid_of(self._shapes[k])
            nodes = grid.shape[0] * grid.shape[1]
            if count < nodes:
                return None, np.empty(0)
            numbers = np.zeros(nodes, np.int64)
            image = self._traced(grid.points(k), numbers, _GRID_FACETS, _FEWEST_GRID_FACETS)
            self._images[k] = grid, image.reshape(*grid.shape, 3)
        return self._images[k]

    def _traced(self, points: Points, numbers: Ints, most: float, least: float) -> Floats:
        """Radiance (n, 3) that points mirror, by between `least` and `most` facets each."""
        starts, out = np.empty(len(points.shape) + 1, np.int64), np.empty((len(points.shape), 3))
        count_facets(points, self._shapes, most / self._parts, least / self._parts, starts)
        hits, radiance = no_points(int(starts[-1])), np.empty((int(starts[-1]), 3))
        firsts = (numbers * self._parts + self._part) * np.diff(starts)
        trace_mirrored(points, firsts, self._shapes, starts, hits)
        albedo = self._albedo_of(hits.shape, hits.place, hits.delay_s)
        shine(hits, albedo, self._shapes, self._lights, radiance)
        mean_of_facets(radiance, starts, out)
        return out


def _some(points: Points, rows: Ints) -> Points:
    """Some of the points."""
    shape, place, normal, viewer, delay = points
    return Points(shape[rows], place[rows], normal[rows], viewer[rows], delay[rows])
