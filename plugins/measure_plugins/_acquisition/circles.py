"""Circles along the borders of colour segments, also of balls partly occluded or touching.

Three points of a border give a circle; its score is the share of its circumference that has the
colour inside and another outside (RANSAC, Fischler and Bolles 1981, with fixed instead of random
samples). A circle of opposite curvature, around an occluder, has no support. The best ones are
fitted to the edge of the segment near them: the mask is read all round a circle at once, radius by
radius, a few more pixels, but no branches.
"""

from __future__ import annotations

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled
from measure.geometry.kernels import cholesky, solve_factored

OFF = 2
"""Value of a mask outside the picture."""

_BATCH_ANGLES = 8
"""Angles that are tested before the next check whether the share can still be reached."""
_REACH = 1.5  # Distance from the circle at which inside and outside are read, in reduced pixels
_MIN_ARC = 2.0  # Least visible arc in reduced pixels, divided by 2 pi: 13 pixels of border
_SPANS = (55, 34, 21, 13, 8, 5)  # Border pixels between the three points
_MIN_BORDER = 10  # Segments with a shorter border, in reduced pixels, are left out
_COMPLETE_SHARE = 0.8
"""Visible share of a circle above which its part of a border is not searched further."""
_CONTAINS_ABOVE = 0.6  # Visible share above which other circles inside one are parts of it


def circles_of(
    bits: Bytes,
    bit: int,
    radii: tuple[float, float],
    least_seen: float,
    least_filled: float,
    most: int,
) -> Floats:
    """Circles of one colour, the best first.

    Args:
        bits: (h, w) colours of each pixel.
        radii: least and greatest radius, in pixels of `bits`.
        least_seen: least share of a circle that must be seen.
        least_filled: least share of its inside that must have the colour.

    Returns:
        (k, 5) centre x, y, radius, share of the circle seen, share of its inside filled.
    """
    mask, best = framed(bits, bit), np.zeros((most, 5))
    for border in borders(mask, _MIN_BORDER):
        _along(border, mask, radii, least_seen, best)
    return np.asarray(distinct(_finished(mask, best, radii, least_filled)))


@compiled
def _along(
    border: Ints, mask: Bytes, radii: tuple[float, float], least: float, best: Floats
) -> None:
    """Keep the best circles along a border: those of points far apart first."""
    n = len(border)
    explained = np.zeros(n, np.uint8)
    worst = float(np.min(best[:, 4]))
    for span in _SPANS:
        if span >= n:
            continue
        for i in range(0, n, 2 * span // 3):
            if explained[i]:
                continue
            j, k = (i + span) % n, (i + 2 * span) % n
            x, y, r = _through(border, i, j, k)
            if not radii[0] <= r <= radii[1] or 2 * span > 5 * r:
                continue
            contrast = _has_contrast(mask, border[i, 0], border[i, 1], x, y)
            contrast &= _has_contrast(mask, border[j, 0], border[j, 1], x, y)
            if not contrast & _has_contrast(mask, border[k, 0], border[k, 1], x, y):
                continue
            # A circle that cannot exceed the worst of the best is given up early.
            needed = max(least, _MIN_ARC / r, min(worst / np.sqrt(r), _COMPLETE_SHARE))
            seen = _share_seen(mask, x, y, r, needed)
            if seen >= needed:
                worst = _keep(best, x, y, r, seen)
            if seen >= _COMPLETE_SHARE:
                _explain(border, x, y, r, explained)


@compiled
def _explain(border: Ints, x: float, y: float, r: float, explained: Bytes) -> None:
    """Mark border points on a complete circle, which would otherwise be found again."""
    for i in range(len(border)):
        dx, dy = border[i, 0] - x, border[i, 1] - y
        if abs(np.sqrt(dx * dx + dy * dy) - r) < _REACH:
            explained[i] = 1


@compiled
def _finished(
    mask: Bytes, circles: Floats, radii: tuple[float, float], least_filled: float
) -> Floats:
    """Refine the best circles; keep (m, 5) those within limits, with their filled share."""
    out = np.empty((len(circles), 5))
    count = 0
    for i in range(len(circles)):
        if not circles[i, 3] > 0:
            continue
        x, y, r, seen = refined(mask, circles[i])
        if not radii[0] <= r <= radii[1]:
            continue
        filled = share_filled(mask, x, y, r)
        if filled >= least_filled:
            out[count] = (x, y, r, seen, filled)
            count += 1
    return out[:count]


@compiled
def distinct(circles: Floats) -> Floats:
    """Sort circles (k, 5); leave out repeats of better ones and those inside a complete one."""
    left = circles[:, 3] * np.sqrt(circles[:, 2] * circles[:, 4])
    out = np.empty(circles.shape)
    count = 0
    for _ in range(len(left)):
        i = np.argmax(left)
        left[i] = -np.inf
        x, y, r = circles[i, 0], circles[i, 1], circles[i, 2]
        new = True
        for k in range(count):
            apart = np.sqrt((x - out[k, 0]) ** 2 + (y - out[k, 1]) ** 2)
            reach = 0.9 * out[k, 2] if out[k, 3] > _CONTAINS_ABOVE else 0.4 * max(r, out[k, 2])
            new = new and apart >= reach
        if new:
            out[count] = circles[i]
            count += 1
    return out[:count]


@compiled
def _through(border: Ints, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Centre and radius of the circle through three pixels; radius -1 if they lie on a line."""
    ax, ay = border[i, 0], border[i, 1]
    bx, by = float(border[j, 0] - ax), float(border[j, 1] - ay)
    cx, cy = float(border[k, 0] - ax), float(border[k, 1] - ay)
    twice = 2 * (bx * cy - by * cx)
    if abs(twice) < 1e-6:
        return 0.0, 0.0, -1.0
    b2, c2 = bx * bx + by * by, cx * cx + cy * cy
    x, y = (cy * b2 - by * c2) / twice, (bx * c2 - cx * b2) / twice
    # Border pixels are the last ones inside: the edge is half a pixel further out.
    return ax + x, ay + y, np.sqrt(x * x + y * y) + 0.5


@compiled
def _at(mask: Bytes, x: float, y: float) -> int:
    """1 inside the colour, 0 outside, OFF off the picture; without a branch."""
    column = min(max(x + 1.5, 0.0), mask.shape[1] - 1.0)
    row = min(max(y + 1.5, 0.0), mask.shape[0] - 1.0)
    return mask[np.uint64(np.int64(row)), np.uint64(np.int64(column))]


@compiled
def _has_contrast(mask: Bytes, u: int, v: int, x: float, y: float) -> bool:
    """Whether the colour is on the side of border pixel u, v that faces (x, y), and not beyond."""
    dx, dy = u - x, v - y
    per = 1 / (np.sqrt(dx * dx + dy * dy) + 1e-9)
    dx, dy = dx * per, dy * per
    beyond, within = _at(mask, u + 2 * dx, v + 2 * dy), _at(mask, u - dx, v - dy)
    return (beyond == 0) & (within == 1)


@compiled
def _share_seen(mask: Bytes, x: float, y: float, r: float, needed: float) -> float:
    """Share of a circle with colour inside only; given up (0) once it cannot reach `needed`."""
    hits = 0
    for start in range(0, ANGLES, _BATCH_ANGLES):
        if hits + ANGLES - start < needed * ANGLES:
            return 0.0
        for k in range(start, start + _BATCH_ANGLES):
            c, s = COSINES[k], SINES[k]
            outside = _at(mask, x + (r + _REACH) * c, y + (r + _REACH) * s)
            inside = _at(mask, x + (r - _REACH) * c, y + (r - _REACH) * s)
            hits += int(inside == 1) & int(outside == 0)
    return hits / ANGLES


@compiled
def _keep(best: Floats, x: float, y: float, r: float, seen: float) -> float:
    """Put a circle into `best`: in place of a similar one if better, else of the worst."""
    score = seen * np.sqrt(r)
    place = int(np.argmin(best[:, 4]))
    for i in range(len(best)):
        if best[i, 3] > 0:
            apart = np.sqrt((best[i, 0] - x) ** 2 + (best[i, 1] - y) ** 2)
            if apart < 0.5 * max(r, best[i, 2]):
                place = i
                break
    if score > best[place, 4]:
        best[place] = (x, y, r, seen, score)
    return float(np.min(best[:, 4]))


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
    for reach in _REACHES:
        hits = _equations(_edges(mask, x, y, r, reach), reach, normal, right)
        if hits < _MIN_EDGES:
            break
        cholesky(normal, factor)
        solve_factored(factor, right, step)
        x, y, r = x + step[0], y + step[1], r + step[2]
        seen = hits / ANGLES
    return x, y, r, seen


@compiled
def _edges(mask: Bytes, x: float, y: float, r: float, reach: float) -> Floats:
    """Radii (angles,) where the colour ends, less the circle's; beyond `reach`: nowhere."""
    going = _ring(mask, x, y, np.full(ANGLES, r - reach)) == 1
    edges, offset = np.full(ANGLES, 2 * reach), -reach
    while offset < reach:
        offset += 1.0
        here = _ring(mask, x, y, np.full(ANGLES, r + offset))
        for k in range(ANGLES):
            edges[k] = offset if going[k] & (here[k] == 0) else edges[k]
            going[k] &= here[k] == 1
    going[:] = True
    for _ in range(3):  # back by quarters of a pixel to the first one outside
        here = _ring(mask, x, y, r + (edges - _QUARTER))
        for k in range(ANGLES):
            going[k] &= here[k] == 0
            edges[k] -= _QUARTER * going[k]
    return edges


@compiled
def _ring(mask: Bytes, x: float, y: float, radii: Floats) -> Bytes:
    """The mask at radii (angles,) round x, y."""
    places, here = np.empty(ANGLES, np.int64), np.empty(ANGLES, np.uint8)
    flat, width = mask.reshape(-1), mask.shape[1]
    last_column, last_row = mask.shape[1] - 1.0, mask.shape[0] - 1.0
    for k in range(ANGLES):
        column = min(max(x + radii[k] * COSINES[k] + 1.5, 0.0), last_column)
        row = min(max(y + radii[k] * SINES[k] + 1.5, 0.0), last_row)
        places[k] = np.int64(row) * width + np.int64(column)
    for k in range(ANGLES):
        here[k] = flat[np.uint64(places[k])]
    return here


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


def majority(bits: Bytes) -> Bytes:
    """A 3 x 3 median filter of every bit; pixels at the picture's border count twice.

    Args:
        bits: (h, w) colours of each pixel.
    """
    out, there = np.zeros_like(bits), int(np.bitwise_or.reduce(bits, axis=None))
    for bit in (1 << k for k in range(8)):
        if there & bit:
            out |= np.asarray(cv2.medianBlur(bits & np.uint8(bit), 3), np.uint8)
    return out


def framed(bits: Bytes, bit: int) -> Bytes:
    """(h + 2, w + 2): 1 where pixels have a colour, 0 where not, in a margin of OFF."""
    out = np.full((bits.shape[0] + 2, bits.shape[1] + 2), np.uint8(OFF))
    out[1:-1, 1:-1] = (bits & np.uint8(bit)) != 0
    return out


def borders(mask: Bytes, least: int) -> list[Ints]:
    """Outer borders of a colour's patches, those further up first.

    Args:
        mask: (h + 2, w + 2) of the colour, see `framed`.
        least: borders with fewer pixels are left out.

    Returns:
        (n, 2) pixels x, y of each, in order.
    """
    inner = np.ascontiguousarray(mask[1:-1, 1:-1])
    found, _ = cv2.findContours(inner, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.array(one[:, 0], np.int64) for one in reversed(found) if len(one) >= least]
