"""From light to sampled picture values: tone curve, chroma blurred more than luma.

Webcams interpolate a colour mosaic and store chroma at half the resolution of luma (4:2:0 or
4:2:2), both in encoded values. Interpolation between pixels blurs those once more.
See docs/explanation/outline.md, formula 9.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Reals, Singles
from measure.compiling import compiled
from measure_plugins._outline.sampling.rays import STEPS

CHROMA_PX = 0.8
"""Blur of chroma beyond that of luma."""
_BLUE, _GREEN, _RED = 0.114, 0.587, 0.299  # Weights of the luma of JPEG (BT.601)
CHROMA_REACH = 3
"""Steps to either side over which chroma is blurred: three sigma."""
_STEP = float(STEPS[1] - STEPS[0])
_INTERPOLATED = 1 / 6
"""Variance in px^2 of the blur by bilinear interpolation: t (1 - t), averaged over all places t
between two pixels."""
_SIDE_WEIGHT = _INTERPOLATED / (2 * _STEP**2)
_INTERPOLATING = np.array([0.5 - _SIDE_WEIGHT, _SIDE_WEIGHT])
"""Half the weight of a step in a blur of that variance, and the weight of its neighbours."""
_OFFSETS_PX = np.arange(CHROMA_REACH + 1) * _STEP
_BLURRING = np.exp(-0.5 * _OFFSETS_PX**2 / (CHROMA_PX**2 + _INTERPOLATED))
_BLURRING[0] /= 2
_BLURRING /= 2 * _BLURRING.sum()
"""The same in the blur of colour."""
_TABLE_STEPS = 2048
_NO_LIGHT, _FULL_LIGHT = np.float32(0), np.float32(1)


def encoding(table: Floats) -> Singles:
    """The inverse of a tone table (256,): picture values, 0 to 1, at even steps of sqrt(light).

    In steps of the root, since tone curves are steep in the shade: linear interpolation then errs
    by less than a thirtieth of a level. The last entry is repeated, for full light.
    """
    light = np.linspace(0.0, 1.0, _TABLE_STEPS + 1) ** 2
    values = np.interp(light, table, np.arange(len(table)) / (len(table) - 1))
    return np.append(values, values[-1]).astype(np.float32)


@compiled
def encode(light: Floats, inverse: Singles) -> Singles:
    """Picture values, 0 to 1, of light (3, m, n), by the table of `encoding`."""
    out, lows = np.empty(light.shape, np.float32), np.empty(light.size, np.int32)
    flat, read, top = light.reshape(-1), out.reshape(-1), np.float32(len(inverse) - 2)
    for i in range(light.size):  # single precision halves the time of the roots
        x = np.float32(flat[i])
        x = x if x > _NO_LIGHT else _NO_LIGHT
        x = x if x < _FULL_LIGHT else _FULL_LIGHT
        place = np.sqrt(x) * top
        lows[i] = np.int32(place)
        read[i] = place - np.float32(lows[i])
    for i in range(light.size):
        low = np.uint32(lows[i])  # unsigned: no check for negative indices
        value = inverse[low]
        read[i] = value + read[i] * (inverse[low + np.uint32(1)] - value)
    return out


@compiled
def read_off(values: Reals) -> Reals:
    """Blur BGR values (3, m, n) along the rays as cameras and interpolation do.

    Chroma (blue and red minus luma) is blurred by the camera and by interpolation between pixels,
    luma by the latter alone: the camera's blur of luma is in the light already.

    Args:
        values: (3, m, n).

    Returns:
        (3, m - CHROMA_REACH, n): from the step CHROMA_REACH on; beyond the last step, values are
        taken to go on as they are there.
    """
    m, n = values.shape[1:]
    number = values.dtype.type  # of the values' precision: loops stay in single precision
    of_blue, of_green, of_red = number(_BLUE), number(_GREEN), number(_RED)
    luma, bluer, redder = np.empty_like(values)
    for j in range(m):
        for i in range(n):
            blue, red = values[0, j, i], values[2, j, i]
            grey = of_blue * blue + of_green * values[1, j, i] + of_red * red
            luma[j, i], bluer[j, i], redder[j, i] = grey, blue - grey, red - grey
    out = np.zeros((3, m - CHROMA_REACH, n), values.dtype)
    _blur(bluer, _BLURRING, out[0])
    _blur(luma, _INTERPOLATING, out[1])
    _blur(redder, _BLURRING, out[2])
    for j in range(m - CHROMA_REACH):
        for i in range(n):
            blue, grey, red = out[0, j, i], out[1, j, i], out[2, j, i]
            out[0, j, i], out[2, j, i] = grey + blue, grey + red
            out[1, j, i] = grey - (of_blue * blue + of_red * red) / of_green
    return out


@compiled
def _blur(values: Reals, weights: Floats, out: Reals) -> None:
    """Add rows (m, n), blurred across, to those of `out`; its first is CHROMA_REACH."""
    m, n = values.shape
    for j in range(CHROMA_REACH, m):
        for k in range(len(weights)):
            weight, after = out.dtype.type(weights[k]), min(j + k, m - 1)
            for i in range(n):
                out[j - CHROMA_REACH, i] += weight * (values[j - k, i] + values[after, i])
