"""The dichromatic reflection model (Shafer 1985): a ball's light is body plus surface reflection.

Each pixel inside is split into an amount of the body colour and an amount of grey, the reflected
light. The former is fitted along the whole outline (`shading`), the
latter ray by ray. Profiles are (3, m, n): colours, steps along the rays, rays.
See docs/explanation/outline.md, formulas 3 and 8.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._outline.sampling.rays import CLEAR, FITTED_RAYS, Statuses

GREY = 1 / np.sqrt(3.0)
COLORLESS = 0.15
"""Sine of the angle between a ball's colour and grey below which the two are indistinguishable."""
_OWN_LAST_PX = -3.0
_NEIGHBOURS = tuple(float(w) for w in np.exp(-0.5 * (np.arange(5) / 1.5) ** 2))
"""Weights of a ray and of those one to four further on: a normal distribution of sd 1.5 rays."""


@compiled
def body_color(profiles: Floats, status: Statuses, steps: Floats) -> Floats:
    """Unit colour (3,) of the body reflection: the mean of the least grey well-lit pixels.

    NaN if no pixel is clear and lit.
    """
    m, n = profiles.shape[1:]
    every = max(n // FITTED_RAYS, 1)
    colors = np.empty((3, n * m))
    brightest, greyness = np.empty(n * m), np.empty(n * m)
    count = 0
    for j in range(0, m, 3):
        if steps[j] > _OWN_LAST_PX:
            break
        for i in range(0, n, every):
            if status[i] == CLEAR:
                b, g, r = profiles[0, j, i], profiles[1, j, i], profiles[2, j, i]
                colors[0, count], colors[1, count], colors[2, count] = b, g, r
                brightest[count] = max(b, g, r)
                greyness[count] = (b + g + r) * GREY / np.sqrt(b * b + g * g + r * r + 1e-12)
                count += 1
    brightest, greyness = brightest[:count], greyness[:count]
    if count == 0 or np.max(brightest) <= 0:
        return np.full(3, np.nan)
    high = int(0.9 * (count - 1))
    lit = brightest > 0.25 * np.partition(brightest, high)[high]
    low = int(0.15 * (np.count_nonzero(lit) - 1))
    chosen = lit & (greyness <= np.partition(greyness[lit], low)[low])
    out = np.zeros(3)
    for k in range(count):
        if chosen[k]:
            for c in range(3):
                out[c] += colors[c, k]
    return out / np.sqrt(np.sum(out**2))


@compiled
def split(
    blue: Floats, green: Floats, red: Floats, own: Floats, amount: Floats, grey: Floats
) -> None:
    """Fill amounts (n,) of body colour and grey in colours (n,), by least squares (formula 3)."""
    b = np.sum(own) * GREY
    apart = 1 - b * b
    separable = apart > COLORLESS**2
    per, mixed, greyness = 1 / apart, b / apart, 1.0
    if not separable:
        per, mixed, greyness = 1.0, 0.0, 0.0
    for i in range(len(amount)):
        p = blue[i] * own[0] + green[i] * own[1] + red[i] * own[2]
        q = (blue[i] + green[i] + red[i]) * GREY
        amount[i] = per * p - mixed * q
        grey[i] = greyness * (per * q - mixed * p)


@compiled
def reflected_light(grey: Floats, status: Statuses, solve: Floats) -> Floats:
    """Reflected light (k, n) from amounts of grey (m, n) along the rays (formula 8).

    Args:
        grey: (m, n).
        solve: (k, m) from a profile to the reflected light.

    Returns:
        Weighted means over neighbouring clear rays.
    """
    knots, n = len(solve), grey.shape[1]
    seen = np.nonzero(solve[0])[0]
    single, shares = np.zeros((knots + 1, n)), np.zeros((knots + 1, n))
    if len(seen) > 0:  # else the surface reflects nothing
        first, last = seen[0], seen[-1] + 1
        seen_by = np.ascontiguousarray(solve[:, first:last])
        single[:knots] = np.dot(seen_by, grey[first:last])
    single[knots] = 1.0
    _sum_of_neighbours(single, status, shares)
    out = shares[:knots]
    for k in range(knots):
        for i in range(n):
            out[k, i] /= shares[knots, i] + 1e-9
    return out


@compiled
def _sum_of_neighbours(rows: Floats, status: Statuses, out: Floats) -> None:
    """Fill `out` (k, n) with weighted sums of rows (k, n) over neighbouring clear rays."""
    n = rows.shape[1]
    reach = len(_NEIGHBOURS) - 1
    a, b, c, d, e = _NEIGHBOURS
    ring = np.empty(n + 2 * reach)
    for k in range(len(rows)):
        for i in range(n):
            ring[reach + i] = rows[k, i] if status[i] == CLEAR else 0.0
        for i in range(reach):
            ring[i], ring[reach + n + i] = ring[n + i], ring[reach + i]
        for i in range(n):
            near = a * ring[i + 4] + b * (ring[i + 3] + ring[i + 5])
            far = d * (ring[i + 1] + ring[i + 7]) + e * (ring[i] + ring[i + 8])
            out[k, i] = near + c * (ring[i + 2] + ring[i + 6]) + far
