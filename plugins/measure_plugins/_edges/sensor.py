"""From light to picture values: the tone curve, and colour blurred more than brightness.

Webcams interpolate a colour mosaic and store colour at half the resolution of brightness (4:2:0 or
4:2:2), both in encoded values.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure_plugins._edges.jit import compiled

_CHROMA_PX = 0.8
"""Blur of the colour channels beyond that of brightness; its exact size hardly matters, because
picture and prediction are compared on the same side of it."""


@compiled
def encode(light: Floats, table: Floats) -> Floats:
    """Picture values, 0 to 1, of light of any shape, interpolated in the tone table (256,)."""
    flat = light.ravel()
    out = np.empty(len(flat))
    top = len(table) - 1
    for i in range(len(flat)):
        x = min(max(flat[i], table[0]), table[top])
        low = min(max(np.searchsorted(table, x, side="right") - 1, 0), top - 1)
        out[i] = (low + (x - table[low]) / max(table[low + 1] - table[low], 1e-12)) / top
    return out.reshape(light.shape)


@compiled
def blur_chroma(values: Floats, step_px: float) -> Floats:
    """Blur blue and red minus brightness of BGR values (n, m, 3) along the rays (JPEG's YCbCr)."""
    n, m = values.shape[:2]
    out = np.empty_like(values)
    reach = int(np.ceil(3 * _CHROMA_PX / step_px))
    weights = np.empty(2 * reach + 1)
    for k in range(2 * reach + 1):
        weights[k] = np.exp(-0.5 * ((k - reach) * step_px / _CHROMA_PX) ** 2)
    brightness = np.empty(m)
    for i in range(n):
        for j in range(m):
            v = values[i, j]
            brightness[j] = 0.114 * v[0] + 0.587 * v[1] + 0.299 * v[2]
        for j in range(m):
            blue, red, total = 0.0, 0.0, 0.0
            for k in range(2 * reach + 1):
                at = min(max(j + k - reach, 0), m - 1)
                blue += weights[k] * (values[i, at, 0] - brightness[at])
                red += weights[k] * (values[i, at, 2] - brightness[at])
                total += weights[k]
            blue, red = blue / total, red / total
            out[i, j, 0] = brightness[j] + blue
            out[i, j, 2] = brightness[j] + red
            out[i, j, 1] = brightness[j] - (0.114 * blue + 0.299 * red) / 0.587
    return out
