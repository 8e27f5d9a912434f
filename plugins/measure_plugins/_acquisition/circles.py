"""Circles in a patch of colour, also where part of the ball is hidden or two balls touch.

Three points of a patch's border make a circle; it is judged by how much of its circumference parts
colour inside from other outside (RANSAC, Fischler and Bolles 1981, with fixed instead of random
samples). A circle bent the wrong way, round something in front of the ball, finds no support.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.compiling import compiled
from measure.geometry.linear_kernels import cholesky, solve_factored
from measure_plugins._acquisition.patches import OFF, borders, framed

_ANGLES = 48
_COSINES = np.cos(2 * np.pi * np.arange(_ANGLES) / _ANGLES)
_SINES = np.sin(2 * np.pi * np.arange(_ANGLES) / _ANGLES)
_TOGETHER = 8
"""Angles that are looked at before asking whether the others can still do: guesses cost more."""
_REACH = 1.5
"""Inside and outside are looked up this far from the circle, in reduced pixels."""
_LEAST_ARC = 2.0
"""A circle needs this much arc in sight, in reduced pixels over 2 pi: 13 pixels of border."""
_SPANS = (55, 34, 21, 13, 8, 5)
"""Border pixels between the three points."""
_LEAST_BORDER = 10
"""Specks with a shorter border, in reduced pixels, show too little of any circle."""
_CLEAR = 0.8
"""A circle seen more than this leaves nothing to look for along its part of a border."""
_PLAIN = 0.6
"""A circle seen more than this is a ball: what lies inside it is part of it."""


@compiled
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
        bit: the colour's.
        radii: least and greatest radius, in pixels of `bits`.
        least_seen: least share of a circle that must be seen.
        least_filled: least share of its inside that must have the colour.
        most: how many circles to find.

    Returns:
        (k, 5) centre x, y, radius, share of the circle seen, share of its inside filled.
    """
    mask = framed(bits, bit)
    pixels, ends = borders(mask, _LEAST_BORDER)
    best = np.zeros((most, 4))
    start = 0
    for end in ends:
        _along(pixels[start:end], mask, radii, least_seen, best)
        start = end
    return distinct(_finished(mask, best, radii, least_filled))


@compiled
def _along(
    border: Ints, mask: Bytes, radii: tuple[float, float], least: float, best: Floats
) -> None:
    """Keep the best circles along a border: far-apart points first, which tell circles best."""
    n = len(border)
    explained = np.zeros(n, np.uint8)
    worst = _worst(best)[1]
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
            parted = _parts(mask, border[i, 0], border[i, 1], x, y)
            parted &= _parts(mask, border[j, 0], border[j, 1], x, y)
            if not parted & _parts(mask, border[k, 0], border[k, 1], x, y):
                continue
            # Where the best are found already, lesser ones need not be looked at to their end.
            needed = max(least, _LEAST_ARC / r, min(worst / np.sqrt(r), _CLEAR))
            seen = _share_seen(mask, x, y, r, needed)
            if seen >= needed:
                worst = _keep(best, x, y, r, seen)
            if seen >= _CLEAR:
                _explain(border, x, y, r, explained)


@compiled
def _explain(border: Ints, x: float, y: float, r: float, explained: Bytes) -> None:
    """Mark what lies on a circle that is clear: looking on would find it again and again."""
    for i in range(len(border)):
        dx, dy = border[i, 0] - x, border[i, 1] - y
        if abs(np.sqrt(dx * dx + dy * dy) - r) < _REACH:
            explained[i] = 1


@compiled
def _finished(
    mask: Bytes, circles: Floats, radii: tuple[float, float], least_filled: float
) -> Floats:
    """Refine circles (k, 4) and keep those that are still such; (m, 5), the last: share filled."""
    out = np.empty((len(circles), 5))
    count = 0
    for i in range(len(circles)):
        if not circles[i, 3] > 0:
            continue
        x, y, r, seen = _refined(mask, circles[i])
        if not radii[0] <= r <= radii[1]:
            continue
        filled = _share_filled(mask, x, y, r)
        if filled >= least_filled:
            out[count] = (x, y, r, seen, filled)
            count += 1
    return out[:count]


@compiled
def distinct(circles: Floats) -> Floats:
    """Sort circles (k, 5); leave out repeats of better ones and what lies in a plain ball."""
    order = np.argsort(-circles[:, 3] * np.sqrt(circles[:, 2] * circles[:, 4]), kind="mergesort")
    out = np.empty(circles.shape)
    count = 0
    for i in order:
        x, y, r = circles[i, 0], circles[i, 1], circles[i, 2]
        new = True
        for k in range(count):
            apart = np.sqrt((x - out[k, 0]) ** 2 + (y - out[k, 1]) ** 2)
            reach = 0.9 * out[k, 2] if out[k, 3] > _PLAIN else 0.4 * max(r, out[k, 2])
            new = new and apart >= reach
        if new:
            out[count] = circles[i]
            count += 1
    return out[:count]


@compiled
def _refined(mask: Bytes, circle: Floats) -> tuple[float, float, float, float]:
    """Fit a circle (x, y, r, seen) to the colour's edge near it; returns the same numbers."""
    x, y, r, seen = circle[0], circle[1], circle[2], circle[3]
    normal, right = np.empty((3, 3)), np.empty(3)
    factor, step = np.empty((3, 3)), np.empty(3)
    for reach in (3.0, 2.0, 1.5):
        normal[:], right[:] = 0.0, 0.0
        hits = 0
        for k in range(_ANGLES):
            offset = _edge(mask, x, y, r, k, reach)
            if np.isnan(offset):
                continue
            c, s = _COSINES[k], _SINES[k]
            hits += 1
            normal[0, 0] += c * c
            normal[1, 0] += s * c
            normal[1, 1] += s * s
            normal[2, 0] += c
            normal[2, 1] += s
            right[0] += c * offset
            right[1] += s * offset
            right[2] += offset
        if hits < 6:
            break
        normal[2, 2] = hits
        for a in range(3):
            normal[a, a] += 0.02  # a short arc: stay near what three points said
        cholesky(normal, factor)
        solve_factored(factor, right, step)
        x, y, r = x + step[0], y + step[1], r + step[2]
        seen = hits / _ANGLES
    return x, y, r, seen


@compiled
def _share_filled(mask: Bytes, x: float, y: float, r: float) -> float:
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
def _parts(mask: Bytes, u: int, v: int, x: float, y: float) -> bool:
    """Whether colour lies on the side of a border pixel u, v that faces (x, y), and none beyond."""
    dx, dy = u - x, v - y
    per = 1 / (np.sqrt(dx * dx + dy * dy) + 1e-9)
    dx, dy = dx * per, dy * per
    beyond, within = _at(mask, u + 2 * dx, v + 2 * dy), _at(mask, u - dx, v - dy)
    return (beyond == 0) & (within == 1)


@compiled
def _share_seen(mask: Bytes, x: float, y: float, r: float, needed: float) -> float:
    """Share of a circle that parts colour from other; given up once it cannot reach `needed`."""
    hits = 0
    for start in range(0, _ANGLES, _TOGETHER):
        if hits + _ANGLES - start < needed * _ANGLES:
            return 0.0
        for k in range(start, start + _TOGETHER):
            c, s = _COSINES[k], _SINES[k]
            outside = _at(mask, x + (r + _REACH) * c, y + (r + _REACH) * s)
            inside = _at(mask, x + (r - _REACH) * c, y + (r - _REACH) * s)
            hits += int(inside == 1) & int(outside == 0)
    return hits / _ANGLES


@compiled
def _edge(mask: Bytes, x: float, y: float, r: float, k: int, reach: float) -> float:
    """Where the colour ends along one radius, relative to `r`; NaN if not within `reach`."""
    c, s = _COSINES[k], _SINES[k]
    if _at(mask, x + (r - reach) * c, y + (r - reach) * s) != 1:
        return np.nan
    offset = -reach
    while offset < reach:
        offset += 1.0
        here = _at(mask, x + (r + offset) * c, y + (r + offset) * s)
        if here == OFF:
            return np.nan
        if here == 0:
            for _ in range(3):  # by quarters back to the first that is outside
                if _at(mask, x + (r + offset - 0.25) * c, y + (r + offset - 0.25) * s) == 0:
                    offset -= 0.25
            return offset - 0.125
    return np.nan


@compiled
def _keep(best: Floats, x: float, y: float, r: float, seen: float) -> float:
    """Put a circle into `best`: in place of its double if better, else of the worst.

    Returns:
        The worst one's merit now: what has no more is never kept.
    """
    merit = seen * np.sqrt(r)
    place, least = _worst(best)
    for i in range(len(best)):
        if best[i, 3] > 0:
            apart = np.sqrt((best[i, 0] - x) ** 2 + (best[i, 1] - y) ** 2)
            if apart < 0.5 * max(r, best[i, 2]):
                place, least = i, best[i, 3] * np.sqrt(best[i, 2])
                break
    if merit > least:
        best[place] = (x, y, r, seen)
    return _worst(best)[1]


@compiled
def _worst(best: Floats) -> tuple[int, float]:
    """The first circle of least merit, or the first free place; and that merit."""
    worst, least = 0, np.inf
    for i in range(len(best)):
        merit = best[i, 3] * np.sqrt(best[i, 2])
        if merit < least:
            worst, least = i, merit
    return worst, least
