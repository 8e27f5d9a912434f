"""Mirror reflection of glossy surfaces, compiled: rays from surface points to the next shape.

A surface is smooth (one mirrored ray), or consists of microfacets whose slopes are normally
distributed with the material's roughness. Rays are mirrored by several of the visible facets, which
are drawn in proportion to their projected area (Walter et al. 2007, Heitz 2014). A ray that a facet
mirrors into the surface is mirrored out again.
"""

from __future__ import annotations

import math

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure.simulation.kernels import (
    NOTHING,
    REACH,
    REFLECTANCE,
    ROUGHNESS,
    Lights,
    Points,
    Triple,
    ambient_share,
    enter,
    facing,
    find_normal,
    fresnel,
    mirror_direction,
    offset,
    raised,
    reflect_point,
)

_GRAZING = 1e-9
_ROWS, _COLUMNS = 33, 128


def _visible_slopes() -> Floats:
    """Quantiles of the slopes towards the viewer of visible facets, in standard deviations.

    Returns:
        (_ROWS, _COLUMNS): for t / (1 + t) from 0 to 1, where t is the slope of the line of sight;
        and for middles of equal shares. The density is normal times what is seen, max(s + t, 0).
    """
    slopes = np.linspace(-8.0, 8.0, 4001)
    shares = (np.arange(_COLUMNS) + 0.5) / _COLUMNS
    rows = []
    for share in np.linspace(0, 1, _ROWS):
        seen = np.maximum((1 - share) * slopes + share, 0)
        sums = np.cumsum(np.exp(-(slopes**2) / 2) * seen)
        rows.append(np.interp(shares, sums / sums[-1], slopes))
    return np.array(rows)


_SLOPES = _visible_slopes()
_STEP_1, _STEP_2 = 0.7548776662466927, 0.5698402909980532
"""Additive recurrence of the R2 sequence: it fills the unit square evenly."""


@compiled
def count_facets(points: Points, shapes: Floats, most: float, least: float, starts: Ints) -> None:
    """Numbers of facets that mirror rays for each point, summed up.

    Args:
        points: (n,) the points.
        shapes: (k, ROW).
        most: facets of a rough surface where all light is mirrored; proportional to that share.
        starts: (n + 1,) receives the cumulative number of facets.
    """
    starts[0] = 0
    for i in range(len(points.shape)):
        k, count = points.shape[i], 0
        if shapes[k, REFLECTANCE] > 0:
            mirrors = fresnel(facing(points, i), shapes[k, REFLECTANCE])
            count = math.ceil(max(most * mirrors, least)) if shapes[k, ROUGHNESS] > 0 else 1
        starts[i + 1] = starts[i] + count


@compiled
def mean_of_facets(radiance: Floats, starts: Ints, out: Floats) -> None:
    """Mean radiance (n, 3) of the facets (m, 3) of each point; 0 where there are none."""
    out[:] = 0.0
    for i in range(len(out)):
        for j in range(starts[i], starts[i + 1]):
            for c in range(3):
                out[i, c] += radiance[j, c] / (starts[i + 1] - starts[i])


@compiled
def interpolate(grid: Floats, coordinates: Floats, out: Floats) -> None:
    """Values (n, 3) of a grid (rows, columns, 3) between its nodes, at coordinates (n, 2)."""
    rows, columns = grid.shape[0], grid.shape[1]
    for i in range(len(coordinates)):
        x = min(max(coordinates[i, 0], 0.0), rows - 1.0)
        y = min(max(coordinates[i, 1], 0.0), columns - 1.0)
        row, column = min(int(x), rows - 2), min(int(y), columns - 2)
        u, w = x - row, y - column
        for c in range(3):
            near = (1 - w) * grid[row, column, c] + w * grid[row, column + 1, c]
            far = (1 - w) * grid[row + 1, column, c] + w * grid[row + 1, column + 1, c]
            out[i, c] = (1 - u) * near + u * far


@compiled
def shine(hits: Points, albedo: Floats, shapes: Floats, lights: Lights, out: Floats) -> None:
    """Radiance (n, 3) that mirrored rays bring from the points they meet, B G R.

    Rays are followed over one mirroring: the points met mirror lamps and ambient light only. A ray
    that meets no shape brings the radiance of the surroundings, black below the horizon.
    """
    light = np.empty((1, 6))
    for i in range(len(hits.shape)):
        if hits.shape[i] == NOTHING:
            x, y, z = hits.viewer[i, 0], hits.viewer[i, 1], hits.viewer[i, 2]
            height = max(-raised(x, y, z, lights), 0.0)
            for c in range(3):
                out[i, c] = height * lights.surround[c]
            continue
        x, y, z = mirror_direction(hits, i)
        share = ambient_share(x, y, z, lights)
        for c in range(3):
            light[0, 3 + c] = share * lights.ambient[c]
        reflect_point(hits, i, shapes, lights, light, 0)
        for c in range(3):
            out[i, c] = albedo[i, c] * light[0, c] + light[0, 3 + c]


@compiled
def trace_mirrored(
    points: Points, firsts: Ints, shapes: Floats, starts: Ints, hits: Points
) -> None:
    """Find the first shape that each mirrored ray meets.

    Args:
        points: (n,) where they start.
        firsts: (n,) number of each point's first facet.
        shapes: (k, ROW).
        starts: (n + 1,) of `count_facets`.
        hits: receives the points met, in the order of `points`.
    """
    d = np.empty(3)
    for i in range(len(points.shape)):
        k, n, v = points.shape[i], points.normal[i], points.viewer[i]
        for j in range(starts[i], starts[i + 1]):
            number = firsts[i] + j - starts[i] + 0.5
            _mirror(n, v, shapes[k, ROUGHNESS], number, d)
            _find_next(points, i, d, shapes, hits, j)


@inlined
def _find_next(points: Points, i: int, d: Floats, shapes: Floats, hits: Points, j: int) -> None:
    """Fill hit j: the first shape on the ray from point i in a direction (3,)."""
    delay, ray = points.delay_s[i], (d[0], d[1], d[2])
    p = points.place[i, 0], points.place[i, 1], points.place[i, 2]
    nearest, found = math.inf, NOTHING
    for k in range(len(shapes)):
        # No shape mirrors itself: all are convex.
        if k != points.shape[i] and _within_reach(shapes, k, delay, p, ray):
            away = enter(shapes, k, delay, p, ray)
            if away < nearest:
                nearest, found = away, k
    hits.shape[j], hits.delay_s[j] = found, delay
    for c in range(3):
        hits.viewer[j, c] = -d[c]
        hits.place[j, c] = points.place[i, c] + nearest * d[c] if found != NOTHING else 0.0
    if found != NOTHING:
        find_normal(shapes[found], delay, hits.place[j], hits.normal[j])


@inlined
def _within_reach(shapes: Floats, k: int, delay: float, p: Triple, ray: Triple) -> bool:
    """Whether a ray from `p` along a unit vector passes through the bounding ball of shape k."""
    ax, ay, az = offset(shapes, k, delay, p)
    x, y, z = ray
    along, reach2 = ax * x + ay * y + az * z, shapes[k, REACH] ** 2
    away2 = ax * ax + ay * ay + az * az - reach2
    return (along > 0 or away2 < 0) and along * along >= away2


@inlined
def _mirror(n: Floats, v: Floats, roughness: float, number: float, d: Floats) -> None:
    """Direction (3,) that a facet of a surface of normal `n` mirrors to a viewer along `v`."""
    cosine = n[0] * v[0] + n[1] * v[1] + n[2] * v[2]
    sine = math.sqrt(max(1 - cosine * cosine, 0.0))
    along, across, up = _facet(sine, max(cosine, _GRAZING), roughness, number)
    ax, ay, az = _tangent(n, v, cosine, sine)
    bx, by, bz = n[1] * az - n[2] * ay, n[2] * ax - n[0] * az, n[0] * ay - n[1] * ax
    mx, my, mz = (
        along * ax + across * bx + up * n[0],
        along * ay + across * by + up * n[1],
        along * az + across * bz + up * n[2],
    )
    seen = mx * v[0] + my * v[1] + mz * v[2]
    d[0], d[1], d[2] = 2 * seen * mx - v[0], 2 * seen * my - v[1], 2 * seen * mz - v[2]
    height = d[0] * n[0] + d[1] * n[1] + d[2] * n[2]
    if height < 0:
        for c in range(3):
            d[c] -= 2 * height * n[c]


@inlined
def _facet(
    sine: float, cosine: float, roughness: float, number: float
) -> tuple[float, float, float]:
    """Normal of a visible facet: towards the viewer, across, along the surface's normal."""
    first, second = number * _STEP_1, number * _STEP_2
    raised = cosine / (cosine + roughness * sine)
    x = roughness * _quantile(raised, first - math.floor(first))
    y = roughness * _quantile(1.0, second - math.floor(second))
    length = math.sqrt(x * x + y * y + 1)
    return x / length, y / length, 1 / length


@inlined
def _quantile(raised: float, share: float) -> float:
    """Interpolate in `_SLOPES`."""
    row, column = raised * (_ROWS - 1), min(max(share * _COLUMNS - 0.5, 0.0), _COLUMNS - 1.0)
    i, j = min(int(row), _ROWS - 2), min(int(column), _COLUMNS - 2)
    u, w = row - i, column - j
    low = (1 - w) * _SLOPES[i, j] + w * _SLOPES[i, j + 1]
    return (1 - u) * low + u * ((1 - w) * _SLOPES[i + 1, j] + w * _SLOPES[i + 1, j + 1])


@inlined
def _tangent(n: Floats, v: Floats, cosine: float, sine: float) -> tuple[float, float, float]:
    """Unit tangent towards the viewer; any tangent where the viewer is along the normal."""
    if sine > 1e-6:
        return (
            (v[0] - cosine * n[0]) / sine,
            (v[1] - cosine * n[1]) / sine,
            (v[2] - cosine * n[2]) / sine,
        )
    if abs(n[0]) < 0.5:
        length = math.sqrt(n[1] * n[1] + n[2] * n[2])
        return 0.0, -n[2] / length, n[1] / length
    length = math.sqrt(n[0] * n[0] + n[1] * n[1])
    return -n[1] / length, n[0] / length, 0.0
