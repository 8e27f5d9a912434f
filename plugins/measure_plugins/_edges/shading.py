"""What lights a ball, fitted to what its rays show.

Each pixel inside is split into an amount of the ball's own colour and an amount of grey (reflected
light). The first is fitted by quadratic shading shared along the whole contour, the second ray by
ray. Profiles are (3, m, n): colours, steps along the rays, rays.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import cholesky, solve_factored, times
from measure_plugins._edges.selection import halved, kth_smallest

GREY = 1 / np.sqrt(3.0)
LOBE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5])
"""Which radial function each of the nine angular terms goes with."""
_PAIR = np.array(
    [LOBE[a] * (LOBE[a] + 1) // 2 + LOBE[b] for a in range(len(LOBE)) for b in range(a + 1)]
)
"""Which product of two radial functions, see `_pairs`, each entry of the normal matrix has."""
_COLORLESS = 0.15
"""Sine of the angle between a ball's colour and grey below which the two cannot be told apart."""
FIT_LAST_PX = 1.0
_OWN_LAST_PX = -3.0
_ROUNDS = 4
_COLOR_RAYS = 36
"""Neighbouring rays show much the same: a ball's colour is taken from about so many of them."""
_NEIGHBOURS = tuple(float(w) for w in np.exp(-0.5 * (np.arange(5) / 1.5) ** 2))
"""Weights of a ray, and of those one to four further on."""


@compiled
def own_color(profiles: Floats, free: Floats, steps: Floats) -> Floats:
    """Unit colour (3,) of the ball's own light: the mean of its least grey well-lit pixels."""
    m, n = profiles.shape[1:]
    every = max(n // _COLOR_RAYS, 1)
    colors = np.empty((3, n * m))
    brightest, greyness = np.empty(n * m), np.empty(n * m)
    count = 0
    for j in range(0, m, 3):
        if steps[j] > _OWN_LAST_PX:
            break
        for i in range(0, n, every):
            if free[i] == 0:
                b, g, r = profiles[0, j, i], profiles[1, j, i], profiles[2, j, i]
                colors[0, count], colors[1, count], colors[2, count] = b, g, r
                brightest[count] = max(b, g, r)
                greyness[count] = (b + g + r) * GREY / np.sqrt(b * b + g * g + r * r + 1e-12)
                count += 1
    lit = 0.25 * kth_smallest(brightest.copy(), count, int(0.9 * (count - 1)))
    kept = 0
    lit_greyness = np.empty(count)
    for k in range(count):
        if brightest[k] > lit:
            lit_greyness[kept] = greyness[k]
            kept += 1
    limit = kth_smallest(lit_greyness, kept, int(0.15 * (kept - 1)))
    out = np.zeros(3)
    for k in range(count):
        if brightest[k] > lit and greyness[k] <= limit:
            for c in range(3):
                out[c] += colors[c, k]
    return out / np.sqrt(np.sum(out**2))


@compiled
def split(
    blue: Floats, green: Floats, red: Floats, own: Floats, amount: Floats, grey: Floats
) -> None:
    """Amounts (n,) of a ball's own colour and of grey in colours (n,), by least squares."""
    b = np.sum(own) * GREY
    apart = 1 - b * b
    separable = apart > _COLORLESS**2
    per, mixed, greyness = 1 / apart, b / apart, 1.0
    if not separable:
        per, mixed, greyness = 1.0, 0.0, 0.0
    for i in range(len(amount)):
        p = blue[i] * own[0] + green[i] * own[1] + red[i] * own[2]
        q = (blue[i] + green[i] + red[i]) * GREY
        amount[i] = per * p - mixed * q
        grey[i] = greyness * (per * q - mixed * p)


@compiled
def angular_terms(around: Floats) -> Floats:
    """The nine angular functions (9, n) at cosine and sine around the axis (n, 2)."""
    n = len(around)
    out = np.ones((9, n))
    for i in range(n):
        cosine, sine = around[i, 0], around[i, 1]
        out[3, i], out[4, i] = cosine, sine
        out[5, i], out[6, i] = cosine, sine
        out[7, i], out[8, i] = cosine * cosine - sine * sine, 2 * sine * cosine
    return out


@compiled
def radial_amounts(coefficients: Floats, angular: Floats) -> Floats:
    """How much of each of the six radial functions every ray shows (6, n)."""
    out = np.zeros((6, angular.shape[1]))
    for k in range(9):
        for i in range(angular.shape[1]):
            out[LOBE[k], i] += coefficients[k] * angular[k, i]
    return out


@compiled
def fit_shading(
    amounts: Floats, free: Floats, angular: Floats, steps: Floats, lobes: Floats
) -> Floats:
    """Coefficients (9,) of quadratic shading, robustly.

    Args:
        amounts: (m, n) of the ball's own colour.
        free: (n,) 0 for rays with a clear way.
        angular: (9, n).
        steps: (m,) px along the normal; every second one up to the edge is used.
        lobes: (m, 6) the radial functions.
    """
    last = np.searchsorted(steps, FIT_LAST_PX, side="right")
    seen, around = np.ascontiguousarray(amounts[:last:2].T), angular.T.copy()
    along = np.ascontiguousarray(lobes[:last:2])
    angular_pairs, radial_pairs = _pairs(around), _pairs(along)
    coefficients, limit = np.zeros(9), np.inf
    factor, off = np.empty((9, 9)), seen
    for turn in range(_ROUNDS):
        weights = _shading_weights(off, limit, free)
        right = _shading_side((seen * weights) @ along, around)
        cholesky(_shading_matrix(weights @ radial_pairs, angular_pairs), factor)
        solve_factored(factor, right, coefficients)
        if turn < _ROUNDS - 1:
            shown = radial_amounts(coefficients, angular)
            off = seen - shown.T.copy() @ along.T.copy()
            limit = 5 * 1.4826 * _median_size(off, free) + 5e-4
    return coefficients


@compiled
def _pairs(rows: Floats) -> Floats:
    """Products (n, k (k + 1) / 2) of every column of (n, k) with those up to itself."""
    n, k = rows.shape
    out = np.empty((n, k * (k + 1) // 2))
    for i in range(n):
        at = 0
        for a in range(k):
            for b in range(a + 1):
                out[i, at + b] = rows[i, a] * rows[i, b]
            at += a + 1
    return out


@compiled
def _shading_weights(off: Floats, limit: float, free: Floats) -> Floats:
    """Tukey's weights of residuals (n, m) on free rays."""
    n, m = off.shape
    weights = np.zeros((n, m))
    for i in range(n):
        if free[i] == 0:
            for j in range(m):
                t = off[i, j] / limit
                w = max(1 - t * t, 0.0)
                weights[i, j] = w * w
    return weights


@compiled
def _shading_side(along: Floats, angular: Floats) -> Floats:
    """Right side (9,) of the weighted fit, from sums (n, 6) along each ray."""
    right = np.zeros(9)
    for i in range(len(along)):
        for a in range(9):
            right[a] += along[i, LOBE[a]] * angular[i, a]
    return right


@compiled
def _shading_matrix(along: Floats, angular_pairs: Floats) -> Floats:
    """Normal matrix (9, 9), its lower half, from sums (n, 21) along each ray."""
    total = np.zeros(len(_PAIR))
    for i in range(len(along)):
        for p in range(len(total)):
            total[p] += along[i, _PAIR[p]] * angular_pairs[i, p]
    normal = 1e-3 * np.eye(9)
    at = 0
    for a in range(9):
        for b in range(a + 1):
            normal[a, b] += total[at]
            at += 1
    return normal


@compiled
def _median_size(off: Floats, free: Floats) -> float:
    """Median of the sizes of residuals (n, m) on free rays, from every third step."""
    n, m = off.shape
    sizes = np.empty(m * n)
    count = 0
    for i in range(n):
        if free[i] == 0:
            for j in range(0, m, 3):
                sizes[count] = abs(off[i, j])
                count += 1
    return halved(sizes[:count])


@compiled
def reflected_light(grey: Floats, free: Floats, solve: Floats) -> Floats:
    """Reflected light (k, n) from amounts of grey (m, n) along the rays.

    Args:
        grey: (m, n).
        free: (n,) 0 for rays with a clear way.
        solve: (k, m) from a profile to the reflected light.

    Returns:
        Means over neighbouring free rays, all round (weights of a normal of 1.5 rays).
    """
    knots, n = len(solve), grey.shape[1]
    seen = np.nonzero(solve[0])[0]
    single, shares = np.zeros((knots + 1, n)), np.zeros((knots + 1, n))
    if len(seen) > 0:  # some paint reflects nothing
        first, last = seen[0], seen[-1] + 1
        times(solve[:, first:last], grey[first:last], single[:knots])
    single[knots] = 1.0
    _sum_of_neighbours(single, free, shares)
    out = shares[:knots]
    for k in range(knots):
        for i in range(n):
            out[k, i] /= shares[knots, i] + 1e-9
    return out


@compiled
def _sum_of_neighbours(rows: Floats, free: Floats, out: Floats) -> None:
    """Weighted sums over neighbouring free rays, all round, of rows (k, n) into `out` (k, n)."""
    n = rows.shape[1]
    reach = len(_NEIGHBOURS) - 1
    a, b, c, d, e = _NEIGHBOURS
    ring = np.empty(n + 2 * reach)
    for k in range(len(rows)):
        for i in range(n):
            ring[reach + i] = rows[k, i] if free[i] == 0 else 0.0
        for i in range(reach):
            ring[i], ring[reach + n + i] = ring[n + i], ring[reach + i]
        for i in range(n):
            near = a * ring[i + 4] + b * (ring[i + 3] + ring[i + 5])
            far = d * (ring[i + 1] + ring[i + 7]) + e * (ring[i] + ring[i + 8])
            out[k, i] = near + c * (ring[i + 2] + ring[i + 6]) + far
