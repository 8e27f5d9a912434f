"""Where a profile across an outline passes half-way between inside and outside.

Profiles are (3, m, n): colours, steps along the rays, rays; rays last, so that loops over them are
vectorised, twice as wide in single precision. See docs/explanation/outline.md, formulas 11 and 12.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from measure.arrays import Bools, Bytes, Floats, Reals
from measure.compiling import compiled
from measure.model.frames import FULL
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

_MIN_SD_PX = 0.03
"""Least standard deviation of a crossing: quantisation and interpolation leave as much."""
_SLOPE_PX = 4.0
"""Standard deviation in px of a crossing, per slope of the shading inside (share of contrast per
px): the slope over the 5 px to the window shifts the level, half of that the half level, which
costs 3 px per share of contrast on a blurred edge; half of the whole is taken."""

_Real = TypeVar("_Real", bound=np.floating[Any])


@compiled
def levels(profiles: NDArray[_Real], steps: Floats, window: tuple[float, float]) -> NDArray[_Real]:
    """Median colours (3, n) within a window.

    Args:
        profiles: (3, m, n).
        steps: (m,) px along the normal.
        window: its ends, px.
    """
    n, first, last = profiles.shape[2], 0, 0
    for step in steps:
        first += int(step < window[0])
        last += int(step <= window[1])
    within = np.empty((last - first, 3 * n), profiles.dtype)
    for j in range(last - first):
        for c in range(3):
            for i in range(n):
                within[j, c * n + i] = profiles[c, first + j, i]
    return median_rows(within).reshape(3, n)


@compiled
def median_rows(rows: NDArray[_Real]) -> NDArray[_Real]:
    """Medians (n,) over rows (k, n), which are sorted, place by place.

    By exchanges of neighbouring rows (odd-even transposition sort), whose loops are vectorised.
    """
    (count, n), half = rows.shape, rows.dtype.type(0.5)
    for turn in range(count):
        for j in range(turn % 2, count - 1, 2):
            for i in range(n):
                a, b = rows[j, i], rows[j + 1, i]
                rows[j, i], rows[j + 1, i] = a if a < b else b, b if a < b else a
    out = np.empty(n, rows.dtype)
    for i in range(n):
        out[i] = half * (rows[(count - 1) // 2, i] + rows[count // 2, i])
    return out


@compiled
def project(profiles: Reals, inside: Reals, outside: Reals, colorful: bool) -> tuple[Reals, Floats]:
    """Profiles along their inside-minus-outside colour: 1 inside, 0 outside.

    Args:
        profiles: (3, m, n).
        inside: (3, n) colour inside.
        outside: (3, n) colour outside.
        colorful: leave grey out of the difference, so that colourless reflections do not count.

    Returns:
        Shares (m, n), all 0 for a ray without contrast; contrast (n,).
    """
    m, n = profiles.shape[1:]
    x, contrast = np.empty((m, n), profiles.dtype), np.empty(n)
    toward, origin = np.empty((3, n), profiles.dtype), np.empty(n, profiles.dtype)
    for i in range(n):
        a, b, c = inside[0, i] - outside[0, i], inside[1, i] - outside[1, i], inside[2, i]
        c -= outside[2, i]
        if colorful:
            mean = (a + b + c) / 3
            a, b, c = a - mean, b - mean, c - mean
        square = a * a + b * b + c * c
        contrast[i] = np.sqrt(square)
        per = 1 / square if square > 1e-12 else 0.0
        toward[0, i], toward[1, i], toward[2, i] = a * per, b * per, c * per
        origin[i] = (outside[0, i] * a + outside[1, i] * b + outside[2, i] * c) * per
    for j in range(m):
        for i in range(n):
            x[j, i] = (
                profiles[0, j, i] * toward[0, i]
                + profiles[1, j, i] * toward[1, i]
                + profiles[2, j, i] * toward[2, i]
                - origin[i]
            )
    return x, contrast


@compiled
def crossings(x: Reals, steps: Floats, search_px: float) -> tuple[Reals, Reals]:
    """Where shares (m, n) fall through one half, nearest to 0 (formula 11).

    Args:
        steps: (m,) px along the normal, evenly spaced.
        search_px: the furthest crossing from 0.

    Returns:
        Crossing (n,) in px, NaN if there is none; and the slope there (n,) per px, positive.
    """
    m, n = x.shape
    number = x.dtype.type
    at, slope, furthest = np.full(n, number(np.inf)), np.zeros(n, x.dtype), number(search_px)
    step, half, one = number(steps[1] - steps[0]), number(0.5), number(1.0)
    for j in range(m - 1):
        here = number(steps[j])
        if not -furthest - step <= here <= furthest:
            continue
        for i in range(n):  # without branches, so that the loop is vectorised
            drop = x[j, i] - x[j + 1, i]
            falls = (x[j, i] > half) & (x[j + 1, i] <= half)
            s = here + (x[j, i] - half) / (drop if falls else one) * step
            nearest = falls & (abs(s) <= furthest) & (abs(s) < abs(at[i]))
            at[i] = s if nearest else at[i]
            slope[i] = drop / step if nearest else slope[i]
    for i in range(n):
        if at[i] == np.inf:
            at[i] = np.nan
    return at, slope


@compiled
def uncertainty(
    x: Reals, steps: Floats, at: Reals, slope: Reals, window: tuple[float, float]
) -> Floats:
    """Standard deviations (n,) in px of crossings, from noise and slope (formula 12).

    Args:
        x: (m, n) see `project`.
        steps: (m,) px along the normal.
        at: (n,) from `crossings`.
        slope: (n,) from `crossings`.
        window: where the inside colour was taken, px.
    """
    rough = _roughness(x, steps, at)
    uneven = _unevenness(x, steps, window)
    sd = np.empty(len(at))
    for i in range(len(at)):
        if slope[i] > 0:
            blurred = max(rough[i] / slope[i], _MIN_SD_PX)
            sd[i] = np.sqrt(blurred**2 + (_SLOPE_PX * uneven[i]) ** 2)
        else:
            sd[i] = np.inf
    return sd


@compiled
def _unevenness(x: Reals, steps: Floats, window: tuple[float, float]) -> Reals:
    """Absolute slope of normalised profiles over the inside window (n,), per px."""
    m, n = x.shape
    middle = 0.5 * (window[0] + window[1])
    rise, number = np.zeros(n, x.dtype), x.dtype.type
    low, high = 0, 0
    for j in range(m):
        low += window[0] <= steps[j] < middle
        high += middle < steps[j] <= window[1]
    for j in range(m):
        share = 0.0
        if window[0] <= steps[j] < middle:
            share = -1.0 / low
        elif middle < steps[j] <= window[1]:
            share = 1.0 / high
        if share != 0:
            weight = number(share)
            for i in range(n):
                rise[i] += weight * x[j, i]
    for i in range(n):
        rise[i] = abs(rise[i]) / (0.5 * (window[1] - window[0]))
    return rise


@compiled
def _roughness(x: Reals, steps: Floats, at: Reals) -> Reals:
    """Noise of normalised profiles (n,) more than 3 px from their edges, from second differences.

    Of samples a whole pixel apart: those between the same two pixels share their noise.
    """
    m, n = x.shape
    total, count, number = np.zeros(n, x.dtype), np.zeros(n, x.dtype), x.dtype.type
    none, one, two, far = number(0), number(1), number(2), number(3)
    apart = int(np.ceil(1 / (steps[1] - steps[0])))
    for j in range(2 * apart, m):
        middle = number(steps[j - apart])
        for i in range(n):
            second = abs(x[j, i] - two * x[j - apart, i] + x[j - 2 * apart, i])
            away = one if abs(middle - at[i]) > far else none
            total[i] += away * (second if second < one else one)
            count[i] += away
    for i in range(n):
        # Mean absolute value of a normal variable is 0.798 sd; second differences have sqrt(6) sd.
        total[i] = total[i] / count[i] / 0.798 / np.sqrt(6.0) if count[i] > 0 else 0.05
    return total


_WHITE, _PALE = 0.93, 0.6
"""Picture values, 0 to 1, above which a pixel is a highlight in all colours, and above which the
median of a ball's own inside is white itself."""
HIGHLIGHT_PX = 0.5
"""Standard deviation in px added to edges of rays that begin in a highlight. Of 0.5 and 1, compared
on scenes with known truth, the latter was worse under desk lamps."""


def clipped(pixels: Bytes, points: Floats, normals: Floats, steps: Floats) -> Bools:
    """Which of n rays meet a pixel that is saturated in one colour.

    Args:
        pixels: (h, w, 3).
        points: (n, 2) where the rays begin, px.
        normals: (n, 2) their unit directions.
        steps: (m,) px along the normals, where they are sampled.
    """
    at = np.rint(points + steps[:, None, None] * normals).astype(np.intp)
    height, width = pixels.shape[:2]
    column, row = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
    return np.asarray(np.any(pixels[row, column] >= FULL, axis=(0, 2)))


@compiled
def in_highlights(inside: Reals, status: Statuses) -> Bools:
    """Which of n rays begin in a white highlight, on a ball that is not white itself.

    The edge such a ray shows near the rim is the highlight's, not the outline of the ball.

    Args:
        inside: (3, n) picture values inside the outline, from 0 to 1.
    """
    n = inside.shape[1]
    out, clear, count = np.zeros(n, np.bool_), np.empty(n), 0
    for i in range(n):
        white = min(inside[0, i], min(inside[1, i], inside[2, i]))
        out[i] = white > _WHITE
        if status[i] == CLEAR:
            clear[count] = white
            count += 1
    if count == 0 or np.median(clear[:count]) >= _PALE:
        out[:] = False
    return out
