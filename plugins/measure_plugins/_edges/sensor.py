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
    below a thirtieth of a picture level. The last entry stands twice, so that full light has a
    neighbour too.
    """
    light = np.linspace(0.0, 1.0, _ENCODED + 1) ** 2
    values = np.interp(light, table, np.arange(len(table)) / (len(table) - 1))
    return np.append(values, values[-1])


@compiled
def encode(light: Floats, inverse: Floats) -> Floats:
    """Picture values, 0 to 1, of light (3, m, n), by the table of `encoding`."""
    colors, m, n = light.shape
    out, place = np.empty((colors, m, n)), np.empty(n)
    top = len(inverse) - 2
    for c in range(colors):
        for j in range(m):
            for i in range(n):
                x = light[c, j, i]
                x = x if x > 0.0 else 0.0
                x = x if x < 1.0 else 1.0
                place[i] = np.sqrt(x) * top
            for i in range(n):
                low = np.uint64(place[i])
                value = inverse[low]
                out[c, j, i] = value + (place[i] - low) * (inverse[low + np.uint64(1)] - value)
    return out


def chroma_reach(step_px: float) -> int:
    """How many steps colour is blurred to either side."""
    return int(np.ceil(3 * _CHROMA_PX / step_px))


@compiled
def blur_chroma(values: Floats, step_px: float, first: int) -> Floats:
    """Blur blue and red minus brightness of BGR values (3, m, n) along the rays (JPEG's YCbCr).

    Returns:
        (3, m - first, n): from the step `first` on.
    """
    m, n = values.shape[1:]
    out = np.empty((3, m - first, n))
    weights = _weights(step_px)
    reach = len(weights) // 2
    bluer, redder, brightness = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    for j in range(m):
        for i in range(n):
            blue, red = values[0, j, i], values[2, j, i]
            grey = 0.114 * blue + 0.587 * values[1, j, i] + 0.299 * red
            brightness[j, i], bluer[j, i], redder[j, i] = grey, blue - grey, red - grey
    b, r = np.empty(n), np.empty(n)
    for j in range(first, m):
        b[:], r[:] = 0.0, 0.0
        for k in range(len(weights)):
            at = min(max(j + k - reach, 0), m - 1)
            for i in range(n):
                b[i] += weights[k] * bluer[at, i]
                r[i] += weights[k] * redder[at, i]
        for i in range(n):
            grey = brightness[j, i]
            out[0, j - first, i] = grey + b[i]
            out[2, j - first, i] = grey + r[i]
            out[1, j - first, i] = grey - (0.114 * b[i] + 0.299 * r[i]) / 0.587
    return out


@compiled
def _weights(step_px: float) -> Floats:
    reach = int(np.ceil(3 * _CHROMA_PX / step_px))
    weights = np.empty(2 * reach + 1)
    for k in range(2 * reach + 1):
        weights[k] = np.exp(-0.5 * ((k - reach) * step_px / _CHROMA_PX) ** 2)
    return weights / np.sum(weights)
