"""A circle fitted to the edge of a colour segment near it, and its filled share.

The mask is read all round a circle at once, radius by radius: a few more pixels, but no branches.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled
from measure.geometry.linear_kernels import cholesky, solve_factored

ANGLES = 48
COSINES = np.cos(2 * np.pi * np.arange(ANGLES) / ANGLES)
SINES = np.sin(2 * np.pi * np.arange(ANGLES) / ANGLES)
_REACHES = (3.0, 2.0, 1.5)  # Reach of the search for the edge in successive fits, in reduced pixels
_QUARTER, _HALF_STEP = 0.25, 0.125
_MIN_EDGES = 6
_PRIOR_WEIGHT = 0.02  # Weight of the initial circle, which holds the fit of a short arc


@compiled
def refined(mask: Bytes, circle: Floats) -> tuple[float, float, float, float]:
    """Fit a circle (x, y, r, seen) to the colour's edge near it; returns the same numbers."""
    x, y, r, seen = circle[0], circle[1], circle[2], circle[3]
    normal, right = np.empty((3, 3)), np.empty(3)
    factor, step = np.empty((3, 3)), np.empty(3)
    edges, radii, places = np.empty(ANGLES), np.empty(ANGLES), np.empty(ANGLES, np.int64)
    going, here = np.empty(ANGLES, np.uint8), np.empty(ANGLES, np.uint8)
    for reach in _REACHES:
        _find_edges(mask, x, y, r, reach, edges, radii, places, going, here)
        hits = _equations(edges, reach, normal, right)
        if hits < _MIN_EDGES:
            break
        cholesky(normal, factor)
        solve_factored(factor, right, step)
        x, y, r = x + step[0], y + step[1], r + step[2]
        seen = hits / ANGLES
    return x, y, r, seen


@compiled
def _find_edges(
    mask: Bytes,
    x: float,
    y: float,
    r: float,
    reach: float,
    edges: Floats,
    radii: Floats,
    places: Ints,
    going: Bytes,
    here: Bytes,
) -> None:
    """Fill the radii at which the colour ends, less that of the circle; beyond `reach`: nowhere."""
    radii[:] = r - reach
    _read_ring(mask, x, y, radii, places, here)
    for k in range(ANGLES):
        going[k], edges[k] = here[k] == 1, 2 * reach
    offset = -reach
    while offset < reach:
        offset += 1.0
        radii[:] = r + offset
        _read_ring(mask, x, y, radii, places, here)
        for k in range(ANGLES):
            edges[k] = offset if (going[k] == 1) & (here[k] == 0) else edges[k]
            going[k] &= here[k] == 1
    going[:] = 1
    for _ in range(3):  # back by quarters of a pixel to the first one outside
        for k in range(ANGLES):
            radii[k] = r + (edges[k] - _QUARTER)
        _read_ring(mask, x, y, radii, places, here)
        for k in range(ANGLES):
            going[k] &= here[k] == 0
            edges[k] -= _QUARTER * going[k]


@compiled
def _read_ring(mask: Bytes, x: float, y: float, radii: Floats, places: Ints, here: Bytes) -> None:
    """Fill `here` with the mask at radii (angles,) round x, y, and `places` with their indices."""
    flat, width = mask.reshape(-1), mask.shape[1]
    last_column, last_row = mask.shape[1] - 1.0, mask.shape[0] - 1.0
    for k in range(ANGLES):
        column = min(max(x + radii[k] * COSINES[k] + 1.5, 0.0), last_column)
        row = min(max(y + radii[k] * SINES[k] + 1.5, 0.0), last_row)
        places[k] = np.int64(row) * width + np.int64(column)
    for k in range(ANGLES):
        here[k] = flat[np.uint64(places[k])]


@compiled
def _equations(edges: Floats, reach: float, normal: Floats, right: Floats) -> int:
    """Fill normal matrix (3, 3) and right side (3,) of a step in x, y, r; how many edges count."""
    normal[:], right[:] = 0.0, 0.0
    hits = 0
    for k in range(ANGLES):
        if not edges[k] <= reach:
            continue
        c, s, offset = COSINES[k], SINES[k], edges[k] - _HALF_STEP
        hits += 1
        normal[0, 0] += c * c
        normal[1, 0] += s * c
        normal[1, 1] += s * s
        normal[2, 0] += c
        normal[2, 1] += s
        right[0] += c * offset
        right[1] += s * offset
        right[2] += offset
    normal[2, 2] = hits
    for a in range(3):
        normal[a, a] += _PRIOR_WEIGHT
    return hits


@compiled
def share_filled(mask: Bytes, x: float, y: float, r: float) -> float:
    """Share of the circle's inside, a tenth in from its edge, that has the colour."""
    inside = 0
    matching = 0
    limit = (0.9 * r) ** 2
    for row in range(max(0, int(y - r)), min(mask.shape[0] - 2, int(y + r) + 2)):
        for column in range(max(0, int(x - r)), min(mask.shape[1] - 2, int(x + r) + 2)):
            within = int((column - x) ** 2 + (row - y) ** 2 <= limit)
            inside += within
            matching += within & int(mask[row + 1, column + 1])
    return matching / inside if inside else 0.0
