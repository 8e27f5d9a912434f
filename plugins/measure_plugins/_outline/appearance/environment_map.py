"""What balls mirror of their surroundings, taken from the camera's own pictures of those.

Just inside its outline a ball deflects the line of sight outwards by some tens of degrees. The ray
goes on away from the camera, to something that the camera sees too, at an angle from the ball that
is a share of the deflection, because the camera stands further back.
See docs/explanation/outline.md, formula 22.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.geometry.linear_kernels import add_product
from measure_plugins._outline.appearance.radial_basis import DEFLECTIONS, FADE_RAD

_MIN_COSINE = 0.2  # Cosine from the optical axis below which directions count as unseen
_BEYOND_RAD = float(DEFLECTIONS[1] - DEFLECTIONS[0])
"""Angle past the picture's border over which colours fade out, so that they change continuously
where a ball moves: the step of `DEFLECTIONS`."""
_EVEN_KNOTS = 7
"""The first so many deflections are evenly spaced; at larger ones little is mirrored."""
_MIN_STRENGTH = 1e-6


class EnvironmentMap(NamedTuple):
    """A camera's surroundings on a coarse grid of the undistorted image plane."""

    colors: Floats  # (h, w, 3) chromatic component of the light, B G R; (0, 0, 3) if not known
    corner: Floats  # (2,) x / z and y / z of the first cell
    step: float  # of the grid, in x / z and y / z
    # (4,) angle from the ball at which the camera sees what the ball mirrors, as a share of the
    # deflection, on the right of the picture, below, left and above; less for what is near, like a
    # floor.
    share: Floats
    strength: Floats  # (4,) factor of the light on these sides


def no_environment() -> EnvironmentMap:
    """The map where nothing is known."""
    return EnvironmentMap(np.zeros((0, 0, 3)), np.zeros(2), 1.0, np.zeros(4), np.zeros(4))


@compiled
def environment_reflection(
    environment: EnvironmentMap, grey: Floats, frame: Floats, half_angle: float, around: Floats
) -> Floats:
    """Chromatic light (3, m, n) that a ball mirrors of the map; empty where none is known.

    Less what is seen beside the ball, which `RadialTables.grazing_reflection` adds. It is computed
    on every second ray, and the mean of its neighbours in between.

    Args:
        grey: (m, k) see `RadialTables`.
        frame: (3, 3) about the ball's axis, see `rays.frame_about`.
        half_angle: of its cone, rad.
        around: (n, 2) cosine and sine around the axis.
    """
    n, known = len(around), environment.colors.size > 0
    out = np.zeros((3, len(grey) if known else 0, n))
    if not known:
        return out
    colors = _at_knots(environment, frame, half_angle, np.ascontiguousarray(around[::2]))
    some = np.zeros((len(grey), colors.shape[2]))
    for c in range(3):
        some[:] = 0.0
        add_product(grey, colors[c], some)
        for j in range(len(grey)):
            for i in range(colors.shape[2] - 1):
                out[c, j, 2 * i] = some[j, i]
                out[c, j, 2 * i + 1] = 0.5 * (some[j, i] + some[j, i + 1])
            out[c, j, 2 * colors.shape[2] - 2] = some[j, -1]
            if n % 2 == 0:
                out[c, j, n - 1] = 0.5 * (some[j, -1] + some[j, 0])
    return out


@compiled
def _at_knots(
    environment: EnvironmentMap, frame: Floats, half_angle: float, around: Floats
) -> Floats:
    """Colours (3, k, n) of the map at `DEFLECTIONS`, less those beside the ball."""
    n, sides, beside = len(around), np.empty(4), np.empty(3)
    colors, flat = np.zeros((3, len(DEFLECTIONS), n)), environment.colors.reshape(-1)
    rows, columns = environment.colors.shape[0], environment.colors.shape[1]
    left, top, per = environment.corner[0], environment.corner[1], 1 / environment.step
    row, one = np.uint64(3 * columns), np.uint64(3)
    for i in range(n):
        side_weights(frame, around[i], sides)
        share, strength = _mean(environment.share, sides), _mean(environment.strength, sides)
        if strength < _MIN_STRENGTH:
            continue
        x = around[i, 0] * frame[0, 0] + around[i, 1] * frame[1, 0]
        y = around[i, 0] * frame[0, 1] + around[i, 1] * frame[1, 1]
        z = around[i, 0] * frame[0, 2] + around[i, 1] * frame[1, 2]
        axial, radial = np.cos(half_angle), np.sin(half_angle)
        cosine, sine = np.cos(share * _BEYOND_RAD), np.sin(share * _BEYOND_RAD)
        for k in range(_EVEN_KNOTS):
            depth = axial * frame[2, 2] + radial * z
            deep = max(depth, _MIN_COSINE)
            u = ((axial * frame[2, 0] + radial * x) / deep - left) * per
            v = ((axial * frame[2, 1] + radial * y) / deep - top) * per
            first, a, b, beyond = _place(u, v, rows, columns)
            weight = strength * max(1 - beyond * environment.step / _BEYOND_RAD, 0.0)
            weight = weight if depth > _MIN_COSINE else 0.0
            fades = max(1 - k * _BEYOND_RAD / FADE_RAD, 0.0)
            for c in range(3):
                at = np.uint64(first + c)  # unsigned: no check for negative indices
                upper = (1 - a) * flat[at] + a * flat[at + one]
                lower = (1 - a) * flat[at + row] + a * flat[at + row + one]
                seen = (1 - b) * upper + b * lower
                if k == 0:
                    beside[c] = seen
                colors[c, k, i] = weight * (seen - fades * beside[c])
            axial, radial = cosine * axial - sine * radial, sine * axial + cosine * radial
    return colors


@inlined
def _place(u: float, v: float, rows: int, columns: int) -> tuple[int, float, float, float]:
    """Index of a place's upper left cell, offsets from it, distance outside the grid (cells)."""
    s, t = min(max(u, 0.0), columns - 1.001), min(max(v, 0.0), rows - 1.001)
    column, row = int(s), int(t)
    beyond = np.sqrt((u - s) ** 2 + (v - t) ** 2)
    return 3 * (row * columns + column), s - column, t - row, beyond


@inlined
def _mean(values: Floats, sides: Floats) -> float:
    return values[0] * sides[0] + values[1] * sides[1] + values[2] * sides[2] + values[3] * sides[3]


@compiled
def side_weights(frame: Floats, around: Floats, out: Floats) -> None:
    """Fill weights (4,), of sum 1, of a direction: right, below, left and above the axis."""
    x = around[0] * frame[0, 0] + around[1] * frame[1, 0]
    y = around[0] * frame[0, 1] + around[1] * frame[1, 1]
    per = 1 / (x * x + y * y)
    out[0], out[1] = max(x, 0.0) ** 2 * per, max(y, 0.0) ** 2 * per
    out[2], out[3] = min(x, 0.0) ** 2 * per, min(y, 0.0) ** 2 * per
