"""Grids over the visible side of balls and rods, on which blurred mirror images are computed.

The mirror image on a rough surface changes slowly, except towards the outline: the nodes are
equidistant in the angle between the normal and the direction to the viewer, at the origin.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from measure.arrays import Bools, Floats
from measure.simulation.kernels import KIND, RADIUS, SPHERE, VELOCITY, A, B
from measure.simulation.mirror_kernels import interpolate
from measure.simulation.surface_kernels import Points

_RINGS, _SPOKES = 32, 64
_STRIPS, _STEP_MM = 24, 4.0


class Grid(Protocol):
    """A grid over one shape.

    Attributes:
        shape: numbers of nodes along both coordinates.
    """

    shape: tuple[int, int]

    def points(self, k: int) -> Points:
        """The grid's nodes as points of shape k, row by row."""

    def coordinates(self, points: Points) -> tuple[Floats, Bools]:
        """Grid coordinates (n, 2) of points (n,) of the shape, and which of them it covers (n,)."""


def grid_of(row: Floats) -> Grid:
    """The grid of a ball or a rod, given as the kernels' row of numbers."""
    return BallGrid(row) if row[KIND] == SPHERE else RodGrid(row)


def interpolated(values: Floats, coordinates: Floats) -> Floats:
    """Values (n, 3) at coordinates (n, 2) of a grid's values (rows, columns, 3)."""
    out = np.empty((len(coordinates), 3))
    interpolate(values, coordinates, out)
    return out


class BallGrid:
    """Rings round the point nearest to the viewer; the last ring is the outline."""

    shape = (_RINGS, _SPOKES + 1)

    def __init__(self, row: Floats) -> None:
        self._center, self._radius = row[A : A + 3], row[RADIUS]
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
        self._start, self._radius = row[A : A + 3], row[RADIUS]
        self._velocity = row[VELOCITY : VELOCITY + 3]
        axis = row[B : B + 3] - self._start
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
