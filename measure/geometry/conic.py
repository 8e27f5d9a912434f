"""Ellipses, and how to read one from the matrix of a conic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.errors import DegenerateGeometryError


@dataclass(frozen=True, eq=False)
class Ellipse:
    """An ellipse in a plane.

    Attributes:
        center: (2,).
        semi_axes: (2,) the longer one first, in the units of the plane.
        angle: of the longer axis, in rad from x towards y, in (-pi / 2, pi / 2].
    """

    center: Floats
    semi_axes: Floats
    angle: float

    def points(self, parameters: ArrayLike) -> Floats:
        """Points (n, 2) at `parameters` (n,) in rad, 0 at the end of the longer axis."""
        t = np.asarray(parameters, dtype=np.float64)[..., None]
        major = np.array([np.cos(self.angle), np.sin(self.angle)])
        minor = np.array([-major[1], major[0]])
        a, b = self.semi_axes
        return self.center + a * np.cos(t) * major + b * np.sin(t) * minor


def ellipse_of_conic(conic: ArrayLike) -> Ellipse:
    """The ellipse of points (x, y, 1) with `v^T conic v = 0`.

    Args:
        conic: (3, 3) symmetric, of any scale.

    Raises:
        DegenerateGeometryError: the conic is a hyperbola, a parabola, or has no points.
    """
    q = floats("conic", conic, 3, 3)
    curvature, vectors = np.linalg.eigh(q[:2, :2])
    if curvature[0] * curvature[1] <= 0:
        raise DegenerateGeometryError(
            f"not an ellipse: the conic's curvatures {curvature[0]:.3g} and {curvature[1]:.3g} "
            "differ in sign"
        )
    center = -np.linalg.solve(q[:2, :2], q[:2, 2])
    squares = -(q[2, 2] + q[:2, 2] @ center) / curvature
    if np.any(squares <= 0):
        raise DegenerateGeometryError("not an ellipse: no point lies on the conic")
    order = np.argsort(squares)[::-1]
    x, y = vectors[:, order[0]]
    if x < 0 or (x == 0 and y < 0):
        x, y = -x, -y
    semi_axes: Floats = np.sqrt(squares[order])
    return Ellipse(np.asarray(center, dtype=np.float64), semi_axes, float(np.arctan2(y, x)))
