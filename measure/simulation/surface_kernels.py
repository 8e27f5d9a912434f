"""Positions and normals of the surface points that rays meet, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure.simulation.kernels import BOX, CAPSULE, KIND, NOTHING, RADIUS, TURN, VELOCITY, A, B

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
