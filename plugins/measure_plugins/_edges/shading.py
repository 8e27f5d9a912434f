"""The picture a ball's model predicts along its rays, fitted to what the rays show.

Each pixel inside is split into an amount of the ball's own colour and an amount of grey (reflected
light). The first is fitted by quadratic shading shared along the whole contour, the second ray by
ray; the surroundings are taken as seen. Together and blurred they say what the camera would show if
the outline were where it is predicted, so the edge finder's own error there can be measured.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure_plugins._edges.jit import compiled

_GREY = 1 / np.sqrt(3.0)
_COLORLESS = 0.15
"""Sine of the angle between a ball's colour and grey below which the two cannot be told apart."""
_FIT_LAST_PX = 1.0
_OWN_LAST_PX = -3.0
_ROUNDS = 4
_LOBE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5])
"""Which radial function each of the nine angular terms goes with."""


@compiled
def own_color(profiles: Floats, free: Floats, steps: Floats) -> Floats:
    """Unit colour (3,) of the ball's own light: the mean of its least grey well-lit pixels."""
    n, m = profiles.shape[:2]
    colors = np.empty((n * m, 3))
    brightest = np.empty(n * m)
    count = 0
    for i in range(n):
        if free[i] == 0:
            for j in range(0, m, 3):
                if steps[j] <= _OWN_LAST_PX:
                    colors[count] = profiles[i, j]
                    brightest[count] = np.max(profiles[i, j])
                    count += 1
    lit = 0.25 * np.sort(brightest[:count])[int(0.9 * (count - 1))]
    greyness = np.empty(count)
    kept = 0
    for k in range(count):
        if brightest[k] > lit:
            length = np.sqrt(np.sum(colors[k] ** 2))
            colors[kept] = colors[k]
            greyness[kept] = np.sum(colors[k]) * _GREY / length
            kept += 1
    limit = np.sort(greyness[:kept])[int(0.15 * (kept - 1))]
    out = np.zeros(3)
    for k in range(kept):
        if greyness[k] <= limit:
            out += colors[k]
    return out / np.sqrt(np.sum(out**2))


@compiled
def split(colors: Floats, own: Floats) -> Floats:
    """Amounts (n, 2) of a ball's own colour and of grey in colours (n, 3), by least squares."""
    out = np.zeros((len(colors), 2))
    b = np.sum(own) * _GREY
    apart = 1 - b * b
    separable = apart > _COLORLESS**2
    for i in range(len(colors)):
        p = np.sum(colors[i] * own)
        if separable:
            q = np.sum(colors[i]) * _GREY
            out[i, 0] = (p - b * q) / apart
            out[i, 1] = (q - b * p) / apart
        else:
            out[i, 0] = p
    return out


@compiled
def _angular(cosine: float, sine: float, out: Floats) -> None:
    out[0], out[1], out[2] = 1.0, 1.0, 1.0
    out[3], out[4] = cosine, sine
    out[5], out[6] = cosine, sine
    out[7], out[8] = cosine * cosine - sine * sine, 2 * sine * cosine


@compiled
def _fit_shading(
    amounts: Floats, free: Floats, around: Floats, steps: Floats, lobes: Floats
) -> Floats:
    """Coefficients (9,) of quadratic shading, robustly, from amounts (n, m) of own colour."""
    n, m = amounts.shape
    coefficients, angular, row = np.zeros(9), np.empty(9), np.empty(9)
    residuals, limit = np.empty(n * m), np.inf
    for _ in range(_ROUNDS):
        normal, right = 1e-3 * np.eye(9), np.zeros(9)
        for i in range(n):
            if free[i] != 0:
                continue
            _angular(around[i, 0], around[i, 1], angular)
            for j in range(0, m, 2):
                if steps[j] > _FIT_LAST_PX:
                    break
                for k in range(9):
                    row[k] = lobes[j, _LOBE[k]] * angular[k]
                r = amounts[i, j] - np.sum(row * coefficients)
                t = r / limit
                if abs(t) >= 1:
                    continue
                w = (1 - t * t) ** 2
                for a in range(9):
                    right[a] += w * row[a] * amounts[i, j]
                    for b in range(a + 1):
                        normal[a, b] += w * row[a] * row[b]
        for a in range(9):
            for b in range(a):
                normal[b, a] = normal[a, b]
        coefficients[:] = np.linalg.solve(normal, right)
        count = 0
        for i in range(n):
            if free[i] != 0:
                continue
            _angular(around[i, 0], around[i, 1], angular)
            for j in range(0, m, 2):
                if steps[j] > _FIT_LAST_PX:
                    break
                value = 0.0
                for k in range(9):
                    value += lobes[j, _LOBE[k]] * angular[k] * coefficients[k]
                residuals[count] = abs(amounts[i, j] - value)
                count += 1
        limit = 5 * 1.4826 * np.sort(residuals[:count])[count // 2] + 5e-4
    return coefficients


@compiled
def _smooth(values: Floats, free: Floats) -> Floats:
    """Mean over neighbouring free rays, all round (weights of a normal of 1.5 rays)."""
    n, m = values.shape
    out = np.zeros((n, m))
    for i in range(n):
        total = 1e-9
        for shift in range(-4, 5):
            k = (i + shift) % n
            if free[k] == 0:
                w = np.exp(-0.5 * (shift / 1.5) ** 2)
                total += w
                for j in range(m):
                    out[i, j] += w * values[k, j]
        for j in range(m):
            out[i, j] /= total
    return out


@compiled
def predict_light(
    profiles: Floats,
    free: Floats,
    around: Floats,
    background: Floats,
    steps: Floats,
    diffuse: Floats,
    grey: Floats,
    nearby: Floats,
    outside: Floats,
    solve_grey: Floats,
    tie_grey: Floats,
) -> Floats:
    """Light (n, m, 3) the model predicts along the rays.

    Args:
        profiles: (n, m, 3) light the picture shows at `steps`.
        free: (n,) 0 for rays with a clear way.
        around: (n, 2) cosine and sine around the axis.
        background: (n, 3) light outside the outline.
        steps: (m,) px along the normal.
        diffuse: (m, 6), of `Radial` like the others.
        grey: (m, k).
        nearby: (m,).
        outside: (m,).
        solve_grey: (k, m).
        tie_grey: (k,).
    """
    n, m = profiles.shape[:2]
    own = own_color(profiles, free, steps)
    behind = split(background, own)
    amounts = split(profiles.reshape(n * m, 3), own).reshape(n, m, 2)
    for i in range(n):
        for j in range(m):
            amounts[i, j, 0] -= outside[j] * behind[i, 0]
            amounts[i, j, 1] -= outside[j] * behind[i, 1]
    shading = _fit_shading(np.ascontiguousarray(amounts[:, :, 0]), free, around, steps, diffuse)
    reflected = _smooth(np.ascontiguousarray(amounts[:, :, 1]), free) @ solve_grey.T
    angular = np.empty(9)
    out = np.zeros((n, m, 3))
    knots = len(tie_grey)
    for i in range(n):
        _angular(around[i, 0], around[i, 1], angular)
        for k in range(knots):
            reflected[i, k] = max(reflected[i, k] + tie_grey[k] * behind[i, 1], 0.0)
        for j in range(m):
            body, mirror = 0.0, 0.0
            for k in range(9):
                body += diffuse[j, _LOBE[k]] * angular[k] * shading[k]
            for k in range(knots):
                mirror += grey[j, k] * reflected[i, k]
            body = max(body, 0.0)
            for c in range(3):
                rest = background[i, c] - behind[i, 1] * _GREY
                out[i, j, c] = max(
                    body * own[c]
                    + mirror * _GREY
                    + nearby[j] * rest
                    + outside[j] * background[i, c],
                    0.0,
                )
    return out
