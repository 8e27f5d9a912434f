"""Where rays meet shapes, and the radiance that the surface there sends to its viewer, compiled.

Shapes and lamps are rows of numbers (columns below), in the camera's frame, in mm.

Diffuse light crosses a glossy surface twice, so it fades as (1 - F(in)) (1 - F(out)) towards
grazing angles (F by Schlick 1994). Mirrored are the discs of the lamps, widened by the roughness,
and the surroundings. The fading is why the colour edge of a glossy ball lies inside its outline.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled, inlined

SPHERE, CAPSULE, BOX = 0.0, 1.0, 2.0
KIND, A, B, RADIUS, TURN, VELOCITY, REFLECTANCE, ROUGHNESS, BACKDROP = 0, 1, 4, 7, 8, 17, 20, 21, 22
REACH, ROW = 23, 24
"""Columns of a shape's row: kind; centre or start; end or half size; radius; rotation (9); ...

`REACH` is the radius of a ball about the centre or the start that holds all of the shape.
"""
NOTHING = -1

Triple: TypeAlias = tuple[float, float, float]
"""A place or a direction, by its coordinates."""


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
        near: (n / rays_per_row, j) which of the first j shapes the rays of a pixel can meet.
        rays_per_row: how many consecutive rays share a row of `near`.
        delays_s: (n / rays_per_row,) time of exposure in s after that of the shapes' poses.
        shapes: (k, ROW).
        first: (n,) receives the index of the shape, or `NOTHING`.
        depth: (n,) receives the depth, or infinity.
    """
    for i in range(len(ideal)):
        row = i // rays_per_row
        nearest, found = math.inf, NOTHING
        for k in range(near.shape[1]):
            if near[row, k]:
                ray = ideal[i, 0], ideal[i, 1], 1.0
                d = enter(shapes, k, delays_s[row], (0.0, 0.0, 0.0), ray)
                if d < nearest:
                    nearest, found = d, k
        first[i], depth[i] = found, nearest


@inlined
def enter(shapes: Floats, k: int, delay: float, p: Triple, ray: Triple) -> float:
    """Depth d at which a ray `p + d * (x, y, z)` enters shape k, infinity if it misses."""
    ax, ay, az = offset(shapes, k, delay, p)
    x, y, z = ray
    if shapes[k, KIND] == SPHERE:
        return _enter_sphere(ax, ay, az, shapes[k, RADIUS], x, y, z)
    if shapes[k, KIND] == BOX:
        return _enter_box(shapes, k, ax, ay, az, x, y, z)
    return _enter_capsule(shapes, k, ax, ay, az, x, y, z)


@inlined
def offset(shapes: Floats, k: int, delay: float, p: Triple) -> Triple:
    """Vector from a point to the centre or start of shape k, which has moved for `delay` s."""
    return (
        shapes[k, A] + delay * shapes[k, VELOCITY] - p[0],
        shapes[k, A + 1] + delay * shapes[k, VELOCITY + 1] - p[1],
        shapes[k, A + 2] + delay * shapes[k, VELOCITY + 2] - p[2],
    )


@inlined
def _enter_capsule(
    shapes: Floats, k: int, ax: float, ay: float, az: float, x: float, y: float, z: float
) -> float:
    """Where a ray enters the round side between the ends, or one of the end balls."""
    ux = shapes[k, B] - shapes[k, A]
    uy = shapes[k, B + 1] - shapes[k, A + 1]
    uz = shapes[k, B + 2] - shapes[k, A + 2]
    radius = shapes[k, RADIUS]
    length2 = ux * ux + uy * uy + uz * uz
    along_d = (x * ux + y * uy + z * uz) / length2
    along_a = (ax * ux + ay * uy + az * uz) / length2
    dx, dy, dz = x - along_d * ux, y - along_d * uy, z - along_d * uz
    px, py, pz = ax - along_a * ux, ay - along_a * uy, az - along_a * uz
    a = dx * dx + dy * dy + dz * dz
    b = dx * px + dy * py + dz * pz
    inside = b * b - a * (px * px + py * py + pz * pz - radius**2)
    best = math.inf
    if inside > 0 and a > 0:
        d = (b - math.sqrt(inside)) / a
        where = d * along_d - along_a
        if d > 0 and 0 <= where <= 1:
            best = d
    start = _enter_sphere(ax, ay, az, radius, x, y, z)
    end = _enter_sphere(ax + ux, ay + uy, az + uz, radius, x, y, z)
    return min(best, start, end)


@inlined
def _enter_sphere(
    cx: float, cy: float, cz: float, radius: float, x: float, y: float, z: float
) -> float:
    a = x * x + y * y + z * z
    b = x * cx + y * cy + z * cz
    inside = b * b - a * (cx * cx + cy * cy + cz * cz - radius * radius)
    if inside <= 0:
        return math.inf
    d = (b - math.sqrt(inside)) / a
    return d if d > 0 else math.inf


@inlined
def _enter_box(
    shapes: Floats, k: int, cx: float, cy: float, cz: float, x: float, y: float, z: float
) -> float:
    into, leave = 0.0, math.inf
    for axis in range(3):
        turn = TURN + axis
        rx, ry, rz = shapes[k, turn], shapes[k, turn + 3], shapes[k, turn + 6]
        along = x * rx + y * ry + z * rz
        center = cx * rx + cy * ry + cz * rz
        half = shapes[k, B + axis]
        if abs(along) < 1e-12:
            if abs(center) > half:
                return math.inf
            continue
        near, far = (center - half) / along, (center + half) / along
        into, leave = max(into, min(near, far)), min(leave, max(near, far))
        if into >= leave:
            return math.inf
    return into if into > 0 else math.inf


REUSE = 4
"""Shading is computed for every fourth ray of a pixel and shape, and reused for the others."""


class RayHits(NamedTuple):
    """Rays and the shapes that they meet first."""

    ideal: Floats  # (n, 2) undistorted normalised image coordinates
    per_pixel: int  # how many consecutive rays belong to a pixel
    delays_s: Floats  # (pixels,) time of exposure in s after that of the shapes' poses
    first: Ints  # (n,) and
    depth: Floats  # (n,) as `trace` gives them


class Points(NamedTuple):
    """Points on surfaces, and from where they are seen."""

    shape: Ints  # (n,) which shape each lies on, or `NOTHING` for a ray that meets none
    place: Floats  # (n, 3)
    normal: Floats  # (n, 3) unit vectors outwards
    viewer: Floats  # (n, 3) unit vectors towards the viewer
    delay_s: Floats  # (n,) time of exposure in s after that of the shapes' poses


def no_points(count: int) -> Points:
    """Uninitialised points (count,)."""
    place, normal, viewer = np.empty((3, count, 3))
    return Points(np.full(count, NOTHING), place, normal, viewer, np.empty(count))


@compiled
def choose_lit(rays: RayHits, shapes: int, lit: Ints, source: Ints) -> int:
    """Choose the rays whose shading is computed, and for each ray the one whose shading it takes.

    Args:
        lit: (n,) receives the indices of the chosen rays.
        source: (n,) receives, for each ray, the index into `lit` of the ray that it takes.

    Returns:
        How many are chosen.
    """
    count, last = 0, np.full(shapes, NOTHING)
    for i in range(len(rays.first)):
        k = rays.first[i]
        if i % rays.per_pixel == 0:
            last[:] = NOTHING
        if k == NOTHING:
            continue
        if last[k] == NOTHING or i - lit[last[k]] >= REUSE:
            lit[count], last[k] = i, count
            count += 1
        source[i] = last[k]
    return count


@compiled
def meet(rays: RayHits, chosen: Ints, shapes: Floats, points: Points) -> None:
    """Fill the points (n,) that chosen rays (n,) met."""
    for j in range(len(chosen)):
        i = chosen[j]
        depth, delay = rays.depth[i], rays.delays_s[i // rays.per_pixel]
        p, v = points.place[j], points.viewer[j]
        p[0], p[1], p[2] = depth * rays.ideal[i, 0], depth * rays.ideal[i, 1], depth
        distance = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        for c in range(3):
            v[c] = -p[c] / distance
        points.shape[j], points.delay_s[j] = rays.first[i], delay
        find_normal(shapes[rays.first[i]], delay, p, points.normal[j])


@inlined
def find_normal(shape: Floats, delay: float, p: Floats, n: Floats) -> None:
    """Outward unit normal (3,) at a point of a shape that has moved for `delay` s."""
    if shape[KIND] == BOX:
        _find_box_normal(shape, delay, p, n)
        return
    share = 0.0
    if shape[KIND] == CAPSULE:
        along, length2 = 0.0, 0.0
        for c in range(3):
            u = shape[B + c] - shape[A + c]
            along += (p[c] - shape[A + c] - delay * shape[VELOCITY + c]) * u
            length2 += u * u
        share = min(max(along / length2, 0.0), 1.0)
    for c in range(3):
        center = shape[A + c]
        if share > 0:
            center += share * (shape[B + c] - center)
        n[c] = (p[c] - center - delay * shape[VELOCITY + c]) / shape[RADIUS]


@inlined
def _find_box_normal(shape: Floats, delay: float, p: Floats, n: Floats) -> None:
    face, most, sign = 0, -1.0, 1.0
    for axis in range(3):
        local = 0.0
        for c in range(3):
            off = p[c] - shape[A + c] - delay * shape[VELOCITY + c]
            local += off * shape[TURN + 3 * c + axis]
        share = abs(local) / shape[B + axis]
        if share > most:
            face, most, sign = axis, share, math.copysign(1.0, local)
    for c in range(3):
        n[c] = sign * shape[TURN + 3 * c + face]


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
