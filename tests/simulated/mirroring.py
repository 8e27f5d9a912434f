"""Mirror images on glossy surfaces: one reflection, traced to all other shapes.

The mirror image on a rough surface changes slowly, except towards the outline: the nodes of grids
over the visible side of balls and rods are equidistant in the angle between the normal and the
direction to the viewer, at the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.simulation import kernels
from measure.simulation.kernels import REUSE, Lights, Points, no_points
from measure.simulation.scene import Scene
from tests.simulated.mirror_kernels import (
    count_facets,
    interpolate,
    mean_of_facets,
    shine,
    trace_mirrored,
)

_RINGS, _SPOKES = 32, 64
_STRIPS, _STEP_MM = 24, 4.0


def mirrored(scene: Scene) -> Scene:
    """The scene with glossy shapes that mirror all others, as real ones do."""
    return replace(scene, lighting=replace(scene.lighting, mirror=Mirror))


class Grid(Protocol):
    """A grid over one shape."""

    shape: tuple[int, int]  # numbers of nodes along both coordinates

    def points(self, k: int) -> Points:
        """The grid's nodes as points of shape k, row by row."""

    def coordinates(self, points: Points) -> tuple[Floats, Bools]:
        """Grid coordinates (n, 2) of points (n,) of the shape, and which of them it covers (n,)."""


def grid_of(row: Floats) -> Grid:
    """The grid of a ball or a rod, given as the kernels' row of numbers."""
    return BallGrid(row) if row[kernels.KIND] == kernels.SPHERE else RodGrid(row)


def interpolated(values: Floats, coordinates: Floats) -> Floats:
    """Values (n, 3) at coordinates (n, 2) of a grid's values (rows, columns, 3)."""
    out = np.empty((len(coordinates), 3))
    interpolate(values, coordinates, out)
    return out


class BallGrid:
    """Rings round the point nearest to the viewer; the last ring is the outline."""

    shape = (_RINGS, _SPOKES + 1)

    def __init__(self, row: Floats) -> None:
        self._center, self._radius = row[kernels.A : kernels.A + 3], row[kernels.RADIUS]
        away = float(np.linalg.norm(self._center))
        towards = -self._center / away
        across = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
        across /= np.linalg.norm(across)
        self._axes = np.stack([across, np.cross(towards, across), towards])
        self._widest = float(np.arccos(min(self._radius / away, 1.0)))

    def points(self, k: int) -> Points:
        """The nodes; the last of each ring is the first again."""
        off = np.linspace(0, self._widest, _RINGS)[:, None]
        turn = np.linspace(-np.pi, np.pi, _SPOKES + 1)
        local = [np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), np.cos(off) + 0 * turn]
        normal = np.stack(local, axis=-1).reshape(-1, 3) @ self._axes
        return _seen_points(k, self._center + self._radius * normal, normal)

    def coordinates(self, points: Points) -> tuple[Floats, Bools]:
        """Rings and spokes; all of a ball is covered."""
        x, y, z = self._axes @ points.normal.T
        rings = np.arccos(np.clip(z, -1, 1)) / self._widest * (_RINGS - 1)
        spokes = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * _SPOKES
        return np.column_stack([rings, spokes]), np.ones(len(rings), bool)


class RodGrid:
    """Strips along the round side of a rod, from outline to outline; not its ends."""

    def __init__(self, row: Floats) -> None:
        self._start, self._radius = row[kernels.A : kernels.A + 3], row[kernels.RADIUS]
        self._velocity = row[kernels.VELOCITY : kernels.VELOCITY + 3]
        axis = row[kernels.B : kernels.B + 3] - self._start
        self._length = max(float(np.linalg.norm(axis)), 1e-9)
        self._along = axis / self._length
        self.shape = (int(self._length / _STEP_MM) + 2, _STRIPS)

    def points(self, k: int) -> Points:
        """The nodes."""
        share = np.repeat(np.linspace(0, 1, self.shape[0]), _STRIPS)
        place, towards, across, widest = self._sections(share * self._length)
        angle = np.tile(np.linspace(-1, 1, _STRIPS), self.shape[0]) * widest
        normal = np.cos(angle)[:, None] * towards + np.sin(angle)[:, None] * across
        return _seen_points(k, place + self._radius * normal, normal)

    def coordinates(self, points: Points) -> tuple[Floats, Bools]:
        """Steps along the rod, and strips."""
        way = points.delay_s[:, None] * self._velocity
        reach = (points.place - way - self._start) @ self._along
        _, towards, across, widest = self._sections(reach)
        sine = np.einsum("ij,ij->i", points.normal, across)
        angle = np.arctan2(sine, np.einsum("ij,ij->i", points.normal, towards))
        steps = reach / self._length * (self.shape[0] - 1)
        strips = (angle / widest + 1) / 2 * (_STRIPS - 1)
        return np.column_stack([steps, strips]), (reach > 0) & (reach < self._length)

    def _sections(self, reach: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Cross-sections (n,) at `reach`: centre, directions to viewer and across, half angle."""
        middle = self._start + reach[:, None] * self._along
        towards = -middle + (middle @ self._along)[:, None] * self._along
        away = np.linalg.norm(towards, axis=1)
        towards = towards / away[:, None]
        widest = np.arccos(np.minimum(self._radius / away, 0.999))
        return middle, towards, np.cross(self._along, towards), widest


def _seen_points(k: int, place: Floats, normal: Floats) -> Points:
    viewer = -place / np.linalg.norm(place, axis=1, keepdims=True)
    return Points(np.full(len(place), k), place, normal, viewer, np.zeros(len(place)))


_FACETS = 32.0
"""Facets of a rough surface that mirror rays for one pixel, where all light is mirrored."""
_SOFT_RAD = 0.04  # On balls and rods rougher than this, the mirror image is interpolated on a grid
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
        soft = (shapes[:, kernels.ROUGHNESS] > _SOFT_RAD) & (shapes[:, kernels.REFLECTANCE] > 0)
        self._soft = [
            int(k) for k in np.flatnonzero(soft & (shapes[:, kernels.KIND] != kernels.BOX))
        ]

    def radiance(self, points: Points, numbers: Ints, per_pixel: int) -> Floats:
        """Radiance (n, 3) that points mirror to their viewers, without lamps, B G R.

        Args:
            points: (n,) the points.
            numbers: (n,) index of each point in its pixel.
            per_pixel: rays through a pixel.
        """
        out, left = (
            np.zeros((len(points.shape), 3)),
            self._shapes[points.shape, kernels.REFLECTANCE] > 0,
        )
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
