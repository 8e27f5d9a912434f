"""The inner loops of the ray caster, compiled: what a ray meets, and what light that sends back.

Shapes and lamps come as rows of numbers, everything in the camera's frame. A ray is
`origin + depth * (x, y, 1)`; its origin is the camera, less the way the shape has moved while a
rolling shutter ran.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np
from numba import njit

from measure.arrays import Bools, Floats, Ints

F = TypeVar("F", bound=Callable[..., object])

SPHERE, CAPSULE, BOX = 0.0, 1.0, 2.0
KIND, A, B, RADIUS, TURN, VELOCITY, REFLECTANCE, ROUGHNESS, ROW = 0, 1, 4, 7, 8, 17, 20, 21, 22
"""Columns of a shape's row: kind; centre or start; end or half size; radius; rotation (9); ..."""
LAMP_COLOUR, LAMP_RADIUS, LAMP_ROW = 3, 6, 7
NOTHING = -1
REFERENCE_MM = 1000.0
"""A lamp's irradiance is what it gives at this distance."""
REUSE = 4
"""Of a pixel's rays, which are many where an edge crosses it, every fourth is lit anew."""
_OWN = 1.0001
"""A ball does not hide light from its own surface."""


def compiled(function: F) -> F:
    """Numba's njit, keeping the types; results are the same on every run and thread."""
    return cast("F", njit(cache=True, nogil=True, error_model="numpy")(function))


@compiled
def trace(
    ideal: Floats,
    near: Bools,
    rays_per_row: int,
    delays_s: Floats,
    shapes: Floats,
    first: Ints,
    depth: Floats,
) -> None:
    """Find what each ray meets first.

    Args:
        ideal: (n, 2) undistorted normalised image coordinates.
        near: (n / rays_per_row, k) which shapes the rays of a pixel may meet.
        rays_per_row: how many consecutive rays share a row of `near`.
        delays_s: (n / rays_per_row,) when they are cast, after the time the shapes are given for.
        shapes: (k, ROW).
        first: (n,) receives the index of the shape, or `NOTHING`.
        depth: (n,) receives the depth, or infinity.
    """
    for i in range(len(ideal)):
        row = i // rays_per_row
        nearest, found = math.inf, NOTHING
        for k in range(len(shapes)):
            if near[row, k]:
                d = _enter(shapes[k], ideal[i, 0], ideal[i, 1], delays_s[row])
                if d < nearest:
                    nearest, found = d, k
        first[i], depth[i] = found, nearest


@compiled
def _enter(shape: Floats, x: float, y: float, delay: float) -> float:
    """Depth at which a ray enters a shape, infinity if it misses."""
    ax = shape[A] + delay * shape[VELOCITY]
    ay = shape[A + 1] + delay * shape[VELOCITY + 1]
    az = shape[A + 2] + delay * shape[VELOCITY + 2]
    if shape[KIND] == SPHERE:
        return _enter_sphere(ax, ay, az, shape[RADIUS], x, y)
    if shape[KIND] == BOX:
        return _enter_box(shape, ax, ay, az, x, y)
    # A rod: its round side between the ends, or one of the end balls.
    ux, uy, uz = shape[B] - shape[A], shape[B + 1] - shape[A + 1], shape[B + 2] - shape[A + 2]
    length2 = ux * ux + uy * uy + uz * uz
    along_d = (x * ux + y * uy + uz) / length2
    along_a = (ax * ux + ay * uy + az * uz) / length2
    dx, dy, dz = x - along_d * ux, y - along_d * uy, 1.0 - along_d * uz
    px, py, pz = ax - along_a * ux, ay - along_a * uy, az - along_a * uz
    a = dx * dx + dy * dy + dz * dz
    b = dx * px + dy * py + dz * pz
    inside = b * b - a * (px * px + py * py + pz * pz - shape[RADIUS] ** 2)
    best = math.inf
    if inside > 0 and a > 0:
        d = (b - math.sqrt(inside)) / a
        where = d * along_d - along_a
        if d > 0 and 0 <= where <= 1:
            best = d
    start = _enter_sphere(ax, ay, az, shape[RADIUS], x, y)
    end = _enter_sphere(ax + ux, ay + uy, az + uz, shape[RADIUS], x, y)
    return min(best, start, end)


@compiled
def _enter_sphere(cx: float, cy: float, cz: float, radius: float, x: float, y: float) -> float:
    a = x * x + y * y + 1.0
    b = x * cx + y * cy + cz
    inside = b * b - a * (cx * cx + cy * cy + cz * cz - radius * radius)
    if inside <= 0:
        return math.inf
    d = (b - math.sqrt(inside)) / a
    return d if d > 0 else math.inf


@compiled
def _enter_box(shape: Floats, cx: float, cy: float, cz: float, x: float, y: float) -> float:
    enter, leave = 0.0, math.inf
    for axis in range(3):
        rx, ry, rz = shape[TURN + axis], shape[TURN + 3 + axis], shape[TURN + 6 + axis]
        along = x * rx + y * ry + rz
        center = cx * rx + cy * ry + cz * rz
        half = shape[B + axis]
        if abs(along) < 1e-12:
            if abs(center) > half:
                return math.inf
            continue
        near, far = (center - half) / along, (center + half) / along
        enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
    return enter if 0 < enter < leave else math.inf


@compiled
def shade(
    ideal: Floats,
    rays_per_row: int,
    delays_s: Floats,
    first: Ints,
    depth: Floats,
    shapes: Floats,
    albedo: Floats,
    by_ray: bool,
    lamps: Floats,
    ambient: Floats,
    surround: Floats,
    up_below: Floats,
    blockers: Ints,
    out: Floats,
) -> None:
    """Mean radiance that the surfaces met by a pixel's rays send back; 0 where nothing was met.

    Diffuse light crosses a glossy surface twice, so it fades as (1 - F(in)) (1 - F(out)) towards
    grazing angles (F by Schlick 1994); the mirrored part is the lamp's disc, widened by the
    roughness, and the surroundings. That is why a glossy ball's colour edge lies inside its
    outline.

    Args:
        ideal: (n, 2) undistorted normalised image coordinates.
        rays_per_row: how many consecutive rays share a row of `delays_s`.
        delays_s: (n / rays_per_row,).
        first: (n,) from `trace`.
        depth: (n,) from `trace`.
        shapes: (k, ROW).
        albedo: (n, 3) of the rays, or (k, 3) of the shapes, B G R.
        by_ray: which of the two.
        lamps: (m, LAMP_ROW).
        ambient: (3,) diffuse light from above.
        surround: (6,) radiance of the surroundings straight above, and from the horizon down.
        up_below: (4,) unit vector upwards, and the share of light from below.
        blockers: (j,) shapes that cast shadows.
        out: (n / rays_per_row, 3) receives the radiance, B G R.
    """
    p, n, v = np.empty(3), np.empty(3), np.empty(3)
    last, light = np.full(len(shapes), -1), np.empty((len(shapes), 6))
    out[:] = 0.0
    for i in range(len(ideal)):
        k, row = first[i], i // rays_per_row
        if i % rays_per_row == 0:
            last[:] = -1
        if k == NOTHING:
            continue
        if last[k] < 0 or i - last[k] >= REUSE:
            last[k] = i
            p[0], p[1], p[2] = depth[i] * ideal[i, 0], depth[i] * ideal[i, 1], depth[i]
            for c in range(3):
                p[c] -= delays_s[row] * shapes[k, VELOCITY + c]
            _normal(shapes[k], p, n)
            distance = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            for c in range(3):
                v[c] = -p[c] / distance
            _reflect(p, n, v, k, shapes, lamps, ambient, surround, up_below, blockers, light[k])
        for c in range(3):
            paint = albedo[i, c] if by_ray else albedo[k, c]
            out[row, c] += (paint * light[k, c] + light[k, 3 + c]) / rays_per_row


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
    p: Floats,
    n: Floats,
    v: Floats,
    k: int,
    shapes: Floats,
    lamps: Floats,
    ambient: Floats,
    surround: Floats,
    up_below: Floats,
    blockers: Ints,
    out: Floats,
) -> None:
    """Light (6,) from a point to the viewer: diffuse, per unit of albedo; and mirrored."""
    f0, below = shapes[k, REFLECTANCE], up_below[3]
    facing = min(max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 0.0), 1.0)
    fresnel = _fresnel(facing, f0)
    m0, m1, m2 = (
        2 * facing * n[0] - v[0],
        2 * facing * n[1] - v[1],
        2 * facing * n[2] - v[2],
    )
    raised = 0.5 * (1 + n[0] * up_below[0] + n[1] * up_below[1] + n[2] * up_below[2])
    sky = (below + (1 - below) * raised) * _openness(p, n, k, shapes, blockers)
    height = max(m0 * up_below[0] + m1 * up_below[1] + m2 * up_below[2], 0.0)
    for c in range(3):
        out[c] = (1 - fresnel) * sky * ambient[c]
        out[3 + c] = fresnel * (surround[3 + c] + height * (surround[c] - surround[3 + c]))
    for j in range(len(lamps)):
        lx, ly, lz = lamps[j, 0] - p[0], lamps[j, 1] - p[1], lamps[j, 2] - p[2]
        away = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / away, ly / away, lz / away
        cosine = n[0] * lx + n[1] * ly + n[2] * lz
        size = lamps[j, LAMP_RADIUS] / away
        if cosine <= -size:
            continue
        power = (REFERENCE_MM / away) ** 2 * _unblocked(p, lx, ly, lz, size, k, shapes, blockers)
        # A lamp of finite size sets gradually.
        lit = cosine if cosine > size else (cosine + size) ** 2 / (4 * size)
        diffuse = power * lit * (1 - _fresnel(max(cosine, 0.0), f0)) * (1 - fresnel)
        gloss = 0.0
        if f0 > 0:
            variance = size * size / 2 + (2 * shapes[k, ROUGHNESS]) ** 2
            off = 1 - (m0 * lx + m1 * ly + m2 * lz)
            gloss = fresnel * power * math.exp(-off / variance) / (2 * variance)
        for c in range(3):
            out[c] += lamps[j, LAMP_COLOUR + c] * diffuse
            out[3 + c] += lamps[j, LAMP_COLOUR + c] * gloss


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
