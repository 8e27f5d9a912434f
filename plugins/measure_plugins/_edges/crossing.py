"""Where a profile across an outline passes half-way between inside and outside."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure_plugins._edges.jit import compiled

_MIN_SD_PX = 0.03
"""No crossing is better known: quantisation, and what the interpolation does."""


_SLOPE_PX = 4.0
"""Shading that goes on into the edge moves its half level: px per share of contrast and px.

The level at the edge is then off by the slope times the 5 px to the window, half of that counts,
and the blurred edge falls by about a third per px; half of the whole is taken as one sd.
"""


@compiled
def _median(values: Floats, count: int) -> float:
    """Median of the first `count` values, which it sorts in place: a handful, so by insertion."""
    for i in range(1, count):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@compiled
def levels(
    profiles: Floats, steps: Floats, inside: tuple[float, float], outside: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Median colours (n, 3) inside and outside the edge.

    Args:
        profiles: (n, m, 3).
        steps: (m,) px along the normal.
        inside: the window whose median is the inside colour, px.
        outside: the same outside.
    """
    n, m = profiles.shape[:2]
    low, high = np.empty((n, 3)), np.empty((n, 3))
    within = np.empty(m)
    for i in range(n):
        for c in range(3):
            for window in range(2):
                bounds = inside if window == 0 else outside
                k = 0
                for j in range(m):
                    if bounds[0] <= steps[j] <= bounds[1]:
                        within[k] = profiles[i, j, c]
                        k += 1
                value = _median(within, k)
                if window == 0:
                    low[i, c] = value
                else:
                    high[i, c] = value
    return low, high


@compiled
def crossings(
    profiles: Floats,
    steps: Floats,
    inside: Floats,
    outside: Floats,
    window: tuple[float, float],
    search_px: float,
    colorful: bool,
) -> tuple[Floats, Floats, Floats]:
    """Half-level crossings of profiles projected on their inside-minus-outside colour.

    Args:
        profiles: (n, m, 3) light.
        steps: (m,) px along the normal, evenly spaced.
        inside: (n, 3) colour inside.
        outside: (n, 3) colour outside.
        window: where the inside colour was taken, px.
        search_px: the furthest crossing from 0.
        colorful: leave grey out of the difference, so that colourless reflections do not count.

    Returns:
        Crossing nearest to 0 (n,) in px, NaN if there is none; its standard deviation (n,) in px
        from the scatter of the profile about its two levels; contrast (n,) in light.
    """
    n, m = profiles.shape[:2]
    at, sd, contrast = np.full(n, np.nan), np.full(n, np.inf), np.zeros(n)
    x = np.empty(m)
    for i in range(n):
        d = inside[i] - outside[i]
        if colorful:
            d = d - np.mean(d)
        length = np.sqrt(np.sum(d * d))
        contrast[i] = length
        if not length > 1e-6:
            continue
        for j in range(m):
            x[j] = np.sum((profiles[i, j] - outside[i]) * d) / (length * length)
        slope = 0.0
        for j in range(m - 1):
            if x[j] > 0.5 >= x[j + 1]:
                drop = x[j] - x[j + 1]
                s = steps[j] + (x[j] - 0.5) / drop * (steps[j + 1] - steps[j])
                if abs(s) <= search_px and not abs(s) >= abs(at[i]):
                    at[i] = s
                    slope = drop / (steps[j + 1] - steps[j])
        if slope > 0:
            rough = _roughness(x, steps, at[i])
            uneven = _SLOPE_PX * _unevenness(x, steps, window)
            sd[i] = np.sqrt(max(rough / slope, _MIN_SD_PX) ** 2 + uneven**2)
    return at, sd, contrast


@compiled
def _unevenness(x: Floats, steps: Floats, window: tuple[float, float]) -> float:
    """How much a normalised profile rises or falls over the inside window, per px."""
    middle = 0.5 * (window[0] + window[1])
    low, high, below, above = 0.0, 0.0, 0, 0
    for j in range(len(x)):
        if window[0] <= steps[j] < middle:
            low += x[j]
            below += 1
        elif middle < steps[j] <= window[1]:
            high += x[j]
            above += 1
    return abs(high / above - low / below) / (0.5 * (window[1] - window[0]))


@compiled
def _roughness(x: Floats, steps: Floats, at: float) -> float:
    """Scatter of a normalised profile away from its edge, from second differences.

    Samples are two apart so that interpolation between the same pixels does not hide the noise.
    """
    total, count = 0.0, 0
    for j in range(4, len(x)):
        if abs(steps[j - 2] - at) > 3.0:
            second = x[j] - 2 * x[j - 2] + x[j - 4]
            total += min(abs(second), 1.0)
            count += 1
    if count == 0:
        return 0.05
    # Mean absolute value of a normal variable is 0.798 sd; second differences have sqrt(6) sd.
    return total / count / 0.798 / np.sqrt(6.0)
