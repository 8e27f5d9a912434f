"""Diffuse shading of a ball by a few point lights.

A point light adds the cosine of incidence, and nothing beyond its terminator, where a polynomial of
the normal would become negative. Light that enters a glossy surface is weakened by its Fresnel
reflectance. Lights are rows (k, 4): place in the camera frame in mm, and irradiance one metre away
in any unit; seen from a ball, unit direction and irradiance there. They are near, so that their
terminators differ from ball to ball. See docs/explanation/outline.md, formula 5.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Singles
from measure.compiling import compiled, inlined
from measure_plugins._outline.appearance.shading import AXIAL, RADIAL, UNIFORM

REFERENCE_MM = 1000.0
"""The distance at which a light's irradiance is stated."""
_MIN_UNIFORM = 1e-4  # Diffuse light below which a step along a ray lies past the blurred outline
_NONE, _ONE = np.float32(0), np.float32(1)


def no_point_lights() -> Floats:
    """The array (0, 4) of no lights."""
    return np.zeros((0, 4))


@compiled
def lights_about(point_lights: Floats, frame: Floats, distance: float) -> Floats:
    """Lights (k, 4) as a ball sees them, in the frame about its axis.

    Args:
        point_lights: (k, 4) in the camera frame.
        frame: (3, 3) see `rays.frame_about`.
        distance: of the ball, mm.
    """
    out, way = np.empty_like(point_lights), np.empty(3)
    for k in range(len(point_lights)):
        for a in range(3):
            way[a] = point_lights[k, a] - distance * frame[2, a]
        square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        per = 1 / np.sqrt(square)
        for a in range(3):
            out[k, a] = per * (frame[a, 0] * way[0] + frame[a, 1] * way[1] + frame[a, 2] * way[2])
        out[k, 3] = point_lights[k, 3] * REFERENCE_MM**2 / square
    return out


@compiled
def shade_by_lights(
    diffuse: Floats, fresnel_loss: float, around: Floats, point_lights: Floats
) -> Floats:
    """Diffuse light (m, n) of a ball by point lights, along its rays; (0, n) without lights.

    Args:
        point_lights: (k, 4) seen from the ball.
    """
    n, out = len(around), np.zeros((len(diffuse) if len(point_lights) > 0 else 0, len(around)))
    rows = 0
    for j in range(len(out)):
        if diffuse[j, UNIFORM] > _MIN_UNIFORM:
            rows = j + 1
    # The places of all steps in one row, for one long vectorised loop per light.
    places = rows * n
    ahead, right = np.zeros(places, np.float32), np.zeros(places, np.float32)
    down, total = np.zeros(places, np.float32), np.zeros(places, np.float32)
    for j in range(rows):
        uniform = diffuse[j, UNIFORM]
        if uniform > _MIN_UNIFORM:
            axial, radial = diffuse[j, AXIAL] / uniform, diffuse[j, RADIAL] / uniform
            for i in range(n):
                ahead[j * n + i] = -axial
                right[j * n + i] = radial * around[i, 0]
                down[j * n + i] = radial * around[i, 1]
    for k in range(len(point_lights)):
        _add_light(point_lights[k], fresnel_loss, right, down, ahead, total)
    for j in range(rows):
        for i in range(n):
            out[j, i] = diffuse[j, UNIFORM] * total[j * n + i]
    return out


@inlined
def _add_light(
    source: Floats, fresnel_loss: float, right: Singles, down: Singles, ahead: Singles, out: Singles
) -> None:
    """Add the shading by one light to the sums (k,) (formula 5).

    Args:
        source: (4,) the light, seen from the ball.
        right: (k,) first component of the surface normals.
        down: (k,) their second component.
        ahead: (k,) their component along the ball's axis.
        out: (k,) changed.
    """
    x, y, z = np.float32(source[0]), np.float32(source[1]), np.float32(source[2])
    power, kept = np.float32(source[3]), np.float32(source[3] * fresnel_loss)
    for i in range(len(out)):
        light = x * right[i] + y * down[i] + z * ahead[i]
        light = light if light > _NONE else _NONE
        slant = _ONE - light
        slant = slant if slant > _NONE else _NONE
        square = slant * slant
        out[i] += light * (power - kept * (square * square * slant))
