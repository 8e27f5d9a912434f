"""From light to picture values: the tone curve, and colour blurred more than brightness.

Webcams interpolate a colour mosaic and store colour at half the resolution of brightness (4:2:0 or
4:2:2), both in encoded values.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled

_CHROMA_PX = 0.8
"""Blur of the colour channels beyond that of brightness; its exact size hardly matters, because
picture and prediction are compared on the same side of it."""
_ENCODED = 2048


def encoding(table: Floats) -> Floats:
    """The inverse of a tone table (256,): picture values, 0 to 1, at even steps of sqrt(light).

    The root spreads the shade, where tone curves are steep: interpolated linearly, the error is
    below a thirtieth of a picture level.
    """
    light = np.linspace(0.0, 1.0, _ENCODED + 1) ** 2
    return np.interp(light, table, np.arange(len(table)) / (len(table) - 1))


@compiled
def encode(light: Floats, inverse: Floats) -> Floats:
    """Picture values, 0 to 1, of light (3, m, n), by the table of `encoding`."""
    colors, m, n = light.shape
    out = np.empty((colors, m, n))
    top = len(inverse) - 1
    for c in range(colors):
        for j in range(m):
            for i in range(n):
                x = np.sqrt(min(max(light[c, j, i], 0.0), 1.0)) * top
                low = min(int(x), top - 1)
                out[c, j, i] = inverse[low] + (x - low) * (inverse[low + 1] - inverse[low])
    return out


def chroma_reach(step_px: float) -> int:
    """How many steps colour is blurred to either side."""
    return int(np.ceil(3 * _CHROMA_PX / step_px))


@compiled
def blur_chroma(values: Floats, step_px: float) -> Floats:
    """Blur blue and red minus brightness of BGR values (3, m, n) along the rays (JPEG's YCbCr)."""
    m, n = values.shape[1:]
    out = np.empty((3, m, n))
    weights = _weights(step_px)
    reach = len(weights) // 2
    bluer, redder = np.empty((m, n)), np.empty((m, n))
    for j in range(m):
        for i in range(n):
            blue, red = values[0, j, i], values[2, j, i]
            brightness = 0.114 * blue + 0.587 * values[1, j, i] + 0.299 * red
            out[1, j, i] = brightness
            bluer[j, i], redder[j, i] = blue - brightness, red - brightness
    b, r = np.empty(n), np.empty(n)
    for j in range(m):
        b[:], r[:] = 0.0, 0.0
        for k in range(len(weights)):
            at = min(max(j + k - reach, 0), m - 1)
            for i in range(n):
                b[i] += weights[k] * bluer[at, i]
                r[i] += weights[k] * redder[at, i]
        for i in range(n):
            brightness = out[1, j, i]
            out[0, j, i] = brightness + b[i]
            out[2, j, i] = brightness + r[i]
            out[1, j, i] = brightness - (0.114 * b[i] + 0.299 * r[i]) / 0.587
    return out


@compiled
def _weights(step_px: float) -> Floats:
    reach = int(np.ceil(3 * _CHROMA_PX / step_px))
    weights = np.empty(2 * reach + 1)
    for k in range(2 * reach + 1):
        weights[k] = np.exp(-0.5 * ((k - reach) * step_px / _CHROMA_PX) ** 2)
    return weights / np.sum(weights)
