"""Shading: the radiance that a surface point sends to its viewer, compiled.

Shapes and lamps are rows of numbers, in the camera's frame.

Diffuse light crosses a glossy surface twice, so it fades as (1 - F(in)) (1 - F(out)) towards
grazing angles (F by Schlick 1994). Mirrored are the discs of the lamps, widened by the roughness,
and the surroundings. The fading is why the colour edge of a glossy ball lies inside its outline.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure.simulation.kernels import (
    BACKDROP,
    NOTHING,
    RADIUS,
    REFLECTANCE,
    ROUGHNESS,
    VELOCITY,
    A,
    Points,
    RayHits,
)

LAMP_COLOUR, LAMP_RADIUS, LAMP_ROW = 3, 6, 7
REFERENCE_MM = 1000.0
"""The distance from a lamp at which its irradiance is stated."""
_OWN = 1.0001
"""Balls nearer than this, in their squared radius, are the point's own and cast no shadow."""


class Lights(NamedTuple):
    """The light sources."""

    lamps: Floats  # (m, LAMP_ROW)
    ambient: Floats  # (3,) diffuse light from above
    surround: Floats  # (3,) radiance from straight above, where no shape is
    up_below: Floats  # (4,) unit vector upwards, and the share of light from below
    blockers: Ints  # (j,) shapes that cast shadows


@compiled
def reflect(points: Points, mirrored: Floats, shapes: Floats, lights: Lights, out: Floats) -> None:
    """Light from surface points to their viewers.

    Args:
        points: (n,) the points, all on shapes.
        mirrored: (n, 3) radiance of what is mirrored, without lamps, B G R.
        shapes: (k, ROW).
        out: (n, 6) receives diffuse light per unit of albedo, and mirrored light, B G R each.
    """
    for i in range(len(points.shape)):
        for c in range(3):
            out[i, 3 + c] = mirrored[i, c]
        reflect_point(points, i, shapes, lights, out, i)


@compiled
def mean_of_pixels(
    rays: RayHits, source: Ints, light: Floats, albedo: Floats, by_ray: bool, out: Floats
) -> None:
    """Mean radiance of the rays of each pixel; a ray that meets no shape counts 0.

    Args:
        source: (n,) which row of `light` is a ray's.
        light: (j, 6) of `reflect`.
        albedo: (n, 3) of the rays, or (k, 3) of the shapes, B G R.
        by_ray: whether `albedo` is given by ray.
        out: (pixels, 3) receives the radiance, B G R.
    """
    out[:] = 0.0
    for i in range(len(rays.first)):
        k, row = rays.first[i], i // rays.per_pixel
        if k == NOTHING:
            continue
        for c in range(3):
            paint = albedo[i, c] if by_ray else albedo[k, c]
            lit = light[source[i]]
            out[row, c] += (paint * lit[c] + lit[3 + c]) / rays.per_pixel


@inlined
def fresnel(cosine: float, f0: float) -> float:
    """Share of light that is mirrored (Schlick 1994)."""
    if f0 <= 0:
        return 0.0
    return f0 + (1 - f0) * (1 - cosine) ** 5


@inlined
def facing(points: Points, i: int) -> float:
    """Cosine of the angle between a point's normal and the direction to its viewer."""
    n, v = points.normal, points.viewer
    return min(max(n[i, 0] * v[i, 0] + n[i, 1] * v[i, 1] + n[i, 2] * v[i, 2], 0.0), 1.0)


@inlined
def mirror_direction(points: Points, i: int) -> tuple[float, float, float]:
    """The direction that a smooth surface mirrors to its viewer."""
    n, v, cosine = points.normal, points.viewer, facing(points, i)
    return (
        2 * cosine * n[i, 0] - v[i, 0],
        2 * cosine * n[i, 1] - v[i, 1],
        2 * cosine * n[i, 2] - v[i, 2],
    )


@inlined
def raised(x: float, y: float, z: float, lights: Lights) -> float:
    """Sine of the angle of a unit vector above the horizon."""
    up = lights.up_below
    return x * up[0] + y * up[1] + z * up[2]


@inlined
def ambient_share(x: float, y: float, z: float, lights: Lights) -> float:
    """Ambient light from around a direction, as a share of that from straight above."""
    below = lights.up_below[3]
    return below + (1 - below) * 0.5 * (1 + raised(x, y, z, lights))


@inlined
def reflect_point(
    points: Points, i: int, shapes: Floats, lights: Lights, out: Floats, row: int
) -> None:
    """Reflected light of point i in a row of `out`, whose last half holds the mirrored radiance."""
    n = points.normal
    mirrors = fresnel(facing(points, i), shapes[points.shape[i], REFLECTANCE])
    sky = ambient_share(n[i, 0], n[i, 1], n[i, 2], lights)
    sky *= _openness(points, i, shapes, lights.blockers)
    for c in range(3):
        out[row, c] = (1 - mirrors) * sky * lights.ambient[c]
        out[row, 3 + c] *= mirrors
    for j in range(len(lights.lamps)):
        diffuse, gloss = _lamp(points, i, mirrors, shapes, lights.lamps, j, lights.blockers)
        for c in range(3):
            out[row, c] += lights.lamps[j, LAMP_COLOUR + c] * diffuse
            out[row, 3 + c] += lights.lamps[j, LAMP_COLOUR + c] * gloss


@inlined
def _lamp(
    points: Points, i: int, mirrors: float, shapes: Floats, lamps: Floats, j: int, blockers: Ints
) -> tuple[float, float]:
    """Shares of one lamp's light that a point sends to its viewer, diffuse and mirrored."""
    k, p, n = points.shape[i], points.place, points.normal
    lx, ly, lz = lamps[j, 0] - p[i, 0], lamps[j, 1] - p[i, 1], lamps[j, 2] - p[i, 2]
    away = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / away, ly / away, lz / away
    cosine = n[i, 0] * lx + n[i, 1] * ly + n[i, 2] * lz
    size = lamps[j, LAMP_RADIUS] / away
    if cosine <= -size:
        return 0.0, 0.0
    f0 = shapes[k, REFLECTANCE]
    power = (REFERENCE_MM / away) ** 2 * _unblocked(points, i, lx, ly, lz, size, shapes, blockers)
    # A lamp of finite size sets gradually.
    lit = cosine if cosine > size else (cosine + size) ** 2 / (4 * size)
    diffuse = power * lit * (1 - fresnel(max(cosine, 0.0), f0)) * (1 - mirrors)
    if f0 <= 0:
        return diffuse, 0.0
    x, y, z = mirror_direction(points, i)
    variance = size * size / 2 + (2 * shapes[k, ROUGHNESS]) ** 2
    off = 1 - (x * lx + y * ly + z * lz)
    return diffuse, mirrors * power * math.exp(-off / variance) / (2 * variance)


@inlined
def _openness(points: Points, i: int, shapes: Floats, blockers: Ints) -> float:
    """Share of the ambient light that other balls do not block (form factor of a ball)."""
    left, n = 1.0, points.normal
    for b in blockers:
        if not _darkens(b, points.shape[i], shapes):
            continue
        x, y, z = _to_center(points, i, shapes, b)
        distance2, radius2 = x * x + y * y + z * z, shapes[b, RADIUS] ** 2
        if distance2 > radius2 * _OWN:
            cosine = max((x * n[i, 0] + y * n[i, 1] + z * n[i, 2]) / math.sqrt(distance2), 0.0)
            left *= 1 - 0.8 * cosine * radius2 / distance2
    return left


@inlined
def _unblocked(
    points: Points,
    i: int,
    lx: float,
    ly: float,
    lz: float,
    size: float,
    shapes: Floats,
    blockers: Ints,
) -> float:
    """Share of a lamp's disc that no ball hides from the point."""
    left = 1.0
    for b in blockers:
        if not _darkens(b, points.shape[i], shapes):
            continue
        x, y, z = _to_center(points, i, shapes, b)
        radius, along = shapes[b, RADIUS], x * lx + y * ly + z * lz
        if along > radius * _OWN:
            across = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
            share = min(max((across - radius) / (2 * along * size) + 0.5, 0.0), 1.0)
            left *= share * share * (3 - 2 * share)
    return left


@inlined
def _darkens(blocker: int, k: int, shapes: Floats) -> bool:
    """Whether a ball casts a shadow on shape k: only where both or neither are backdrop."""
    return blocker != k and shapes[blocker, BACKDROP] == shapes[k, BACKDROP]


@inlined
def _to_center(points: Points, i: int, shapes: Floats, b: int) -> tuple[float, float, float]:
    """Vector from a point to the centre of a ball."""
    p, delay = points.place, points.delay_s[i]
    return (
        shapes[b, A] + delay * shapes[b, VELOCITY] - p[i, 0],
        shapes[b, A + 1] + delay * shapes[b, VELOCITY + 1] - p[i, 1],
        shapes[b, A + 2] + delay * shapes[b, VELOCITY + 2] - p[i, 2],
    )
