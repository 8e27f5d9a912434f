"""What light a met surface sends back to the camera, compiled.

Shapes and lamps come as rows of numbers, everything in the camera's frame.

Diffuse light crosses a glossy surface twice, so it fades as (1 - F(in)) (1 - F(out)) towards
grazing angles (F by Schlick 1994); the mirrored part is the lamp's disc, widened by the roughness,
and the surroundings. That is why a glossy ball's colour edge lies inside its outline.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.simulation.kernels import (
    BOX,
    CAPSULE,
    KIND,
    NOTHING,
    RADIUS,
    REFLECTANCE,
    ROUGHNESS,
    TURN,
    VELOCITY,
    A,
    B,
    compiled,
)

LAMP_COLOUR, LAMP_RADIUS, LAMP_ROW = 3, 6, 7
REFERENCE_MM = 1000.0
"""A lamp's irradiance is what it gives at this distance."""
REUSE = 4
"""Of a pixel's rays, which are many where an edge crosses it, every fourth is lit anew."""
_OWN = 1.0001
"""A ball does not hide light from its own surface."""


class Rays(NamedTuple):
    """Rays and what they met.

    Attributes:
        ideal: (n, 2) undistorted normalised image coordinates.
        per_pixel: how many consecutive rays belong to a pixel.
        delays_s: (pixels,) when they are cast, after the time the shapes are given for.
        first: (n,) and
        depth: (n,) as `trace` gives them.
    """

    ideal: Floats
    per_pixel: int
    delays_s: Floats
    first: Ints
    depth: Floats


class Lights(NamedTuple):
    """Where light comes from.

    Attributes:
        lamps: (m, LAMP_ROW).
        ambient: (3,) diffuse light from above.
        surround: (6,) radiance of the surroundings straight above, and from the horizon down.
        up_below: (4,) unit vector upwards, and the share of light from below.
        blockers: (j,) shapes that cast shadows.
    """

    lamps: Floats
    ambient: Floats
    surround: Floats
    up_below: Floats
    blockers: Ints


@compiled
def shade(
    rays: Rays, shapes: Floats, albedo: Floats, by_ray: bool, lights: Lights, out: Floats
) -> None:
    """Mean radiance that the surfaces met by a pixel's rays send back; 0 where nothing was met.

    Args:
        rays: the rays.
        shapes: (k, ROW).
        albedo: (n, 3) of the rays, or (k, 3) of the shapes, B G R.
        by_ray: which of the two.
        lights: lamps and surroundings.
        out: (pixels, 3) receives the radiance, B G R.
    """
    p, n, v = np.empty(3), np.empty(3), np.empty(3)
    last, light = np.full(len(shapes), -1), np.empty((len(shapes), 6))
    out[:] = 0.0
    for i in range(len(rays.ideal)):
        k, row = rays.first[i], i // rays.per_pixel
        if i % rays.per_pixel == 0:
            last[:] = -1
        if k == NOTHING:
            continue
        if last[k] < 0 or i - last[k] >= REUSE:
            last[k] = i
            _meet(shapes[k], rays.ideal[i], rays.depth[i], rays.delays_s[row], p, n, v)
            _reflect(p, n, v, k, shapes, lights, light[k])
        for c in range(3):
            paint = albedo[i, c] if by_ray else albedo[k, c]
            out[row, c] += (paint * light[k, c] + light[k, 3 + c]) / rays.per_pixel


@compiled
def _meet(
    shape: Floats, ray: Floats, depth: float, delay: float, p: Floats, n: Floats, v: Floats
) -> None:
    """Point (3,) where a ray meets a shape, the normal there, and the direction to the viewer."""
    p[0], p[1], p[2] = depth * ray[0], depth * ray[1], depth
    for c in range(3):
        p[c] -= delay * shape[VELOCITY + c]
    _normal(shape, p, n)
    distance = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    for c in range(3):
        v[c] = -p[c] / distance


@compiled
def _normal(shape: Floats, p: Floats, n: Floats) -> None:
    """Outward unit normal (3,) at a surface point."""
    if shape[KIND] == BOX:
        _box_normal(shape, p, n)
        return
    share = 0.0
    if shape[KIND] == CAPSULE:
        along, length2 = 0.0, 0.0
        for c in range(3):
            u = shape[B + c] - shape[A + c]
            along += (p[c] - shape[A + c]) * u
            length2 += u * u
        share = min(max(along / length2, 0.0), 1.0)
    for c in range(3):
        center = shape[A + c]
        if share > 0:
            center += share * (shape[B + c] - center)
        n[c] = (p[c] - center) / shape[RADIUS]


@compiled
def _box_normal(shape: Floats, p: Floats, n: Floats) -> None:
    face, most, sign = 0, -1.0, 1.0
    for axis in range(3):
        local = 0.0
        for c in range(3):
            local += (p[c] - shape[A + c]) * shape[TURN + 3 * c + axis]
        share = abs(local) / shape[B + axis]
        if share > most:
            face, most, sign = axis, share, math.copysign(1.0, local)
    for c in range(3):
        n[c] = sign * shape[TURN + 3 * c + face]


@compiled
def _reflect(
    p: Floats, n: Floats, v: Floats, k: int, shapes: Floats, lights: Lights, out: Floats
) -> None:
    """Light (6,) from a point to the viewer (diffuse, per unit of albedo; mirrored); alters `v`."""
    up, below = lights.up_below, lights.up_below[3]
    ambient, surround = lights.ambient, lights.surround
    facing = min(max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 0.0), 1.0)
    fresnel = _fresnel(facing, shapes[k, REFLECTANCE])
    for c in range(3):
        v[c] = 2 * facing * n[c] - v[c]  # from here on the mirrored direction
    raised = 0.5 * (1 + n[0] * up[0] + n[1] * up[1] + n[2] * up[2])
    sky = (below + (1 - below) * raised) * _openness(p, n, k, shapes, lights.blockers)
    height = max(v[0] * up[0] + v[1] * up[1] + v[2] * up[2], 0.0)
    for c in range(3):
        out[c] = (1 - fresnel) * sky * ambient[c]
        out[3 + c] = fresnel * (surround[3 + c] + height * (surround[c] - surround[3 + c]))
    for j in range(len(lights.lamps)):
        _add_lamp(p, n, v, fresnel, k, shapes, lights.lamps[j], lights.blockers, out)


@compiled
def _add_lamp(
    p: Floats,
    n: Floats,
    mirrored: Floats,
    fresnel: float,
    k: int,
    shapes: Floats,
    lamp: Floats,
    blockers: Ints,
    out: Floats,
) -> None:
    """One lamp's share of the light from a point to the viewer."""
    lx, ly, lz = lamp[0] - p[0], lamp[1] - p[1], lamp[2] - p[2]
    away = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / away, ly / away, lz / away
    cosine = n[0] * lx + n[1] * ly + n[2] * lz
    size = lamp[LAMP_RADIUS] / away
    if cosine <= -size:
        return
    f0 = shapes[k, REFLECTANCE]
    power = (REFERENCE_MM / away) ** 2 * _unblocked(p, lx, ly, lz, size, k, shapes, blockers)
    # A lamp of finite size sets gradually.
    lit = cosine if cosine > size else (cosine + size) ** 2 / (4 * size)
    diffuse = power * lit * (1 - _fresnel(max(cosine, 0.0), f0)) * (1 - fresnel)
    gloss = 0.0
    if f0 > 0:
        variance = size * size / 2 + (2 * shapes[k, ROUGHNESS]) ** 2
        off = 1 - (mirrored[0] * lx + mirrored[1] * ly + mirrored[2] * lz)
        gloss = fresnel * power * math.exp(-off / variance) / (2 * variance)
    for c in range(3):
        out[c] += lamp[LAMP_COLOUR + c] * diffuse
        out[3 + c] += lamp[LAMP_COLOUR + c] * gloss


@compiled
def _fresnel(cosine: float, f0: float) -> float:
    if f0 <= 0:
        return 0.0
    return f0 + (1 - f0) * (1 - cosine) ** 5


@compiled
def _openness(p: Floats, n: Floats, k: int, shapes: Floats, blockers: Ints) -> float:
    """Share of the ambient light that other balls leave (form factor of a ball)."""
    left = 1.0
    for b in blockers:
        if b == k:
            continue
        s = shapes[b]
        x, y, z = s[A] - p[0], s[A + 1] - p[1], s[A + 2] - p[2]
        distance2, radius2 = x * x + y * y + z * z, s[RADIUS] ** 2
        if distance2 > radius2 * _OWN:
            cosine = max((x * n[0] + y * n[1] + z * n[2]) / math.sqrt(distance2), 0.0)
            left *= 1 - 0.8 * cosine * radius2 / distance2
    return left


@compiled
def _unblocked(
    p: Floats, lx: float, ly: float, lz: float, size: float, k: int, shapes: Floats, blockers: Ints
) -> float:
    """Share of a lamp's disc that is seen past the balls in between."""
    left = 1.0
    for b in blockers:
        if b == k:
            continue
        s = shapes[b]
        x, y, z = s[A] - p[0], s[A + 1] - p[1], s[A + 2] - p[2]
        along = x * lx + y * ly + z * lz
        if along > s[RADIUS] * _OWN:
            across = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
            share = min(max((across - s[RADIUS]) / (2 * along * size) + 0.5, 0.0), 1.0)
            left *= share * share * (3 - 2 * share)
    return left
