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
"""Weight of either neighbouring step in a blur of that variance."""
_OFFSETS_PX = np.arange(-CHROMA_REACH, CHROMA_REACH + 1) * _STEP
_WEIGHTS = np.exp(-0.5 * _OFFSETS_PX**2 / (CHROMA_PX**2 + _INTERPOLATED))
_TAPS = (_WEIGHTS / _WEIGHTS.sum())[CHROMA_REACH:].copy()
"""Weights of a step and its neighbours in the blur of colour."""
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
    beyond = m + CHROMA_REACH
    grey, out = np.empty(m * n, values.dtype), np.empty((3, m - CHROMA_REACH, n), values.dtype)
    bluer, redder = np.empty(beyond * n, values.dtype), np.empty(beyond * n, values.dtype)
    blue, green, red = (values[0].reshape(-1), values[1].reshape(-1), values[2].reshape(-1))
    _to_chroma(blue, green, red, grey, bluer, redder)
    for j in range(m, beyond):
        for i in range(n):
            bluer[j * n + i], redder[j * n + i] = bluer[(m - 1) * n + i], redder[(m - 1) * n + i]
    blue, green, red = out[0].reshape(-1), out[1].reshape(-1), out[2].reshape(-1)
    _blur(bluer, n, blue)
    _blur(redder, n, red)
    _from_chroma(_interpolated(grey[(CHROMA_REACH - 1) * n :], n), blue, green, red)
    return out


@compiled
def _to_chroma(
    blue: Reals, green: Reals, red: Reals, grey: Reals, bluer: Reals, redder: Reals
) -> None:
    """Fill luma, and blue and red minus luma, of colours (k,), into the last three."""
    number = grey.dtype.type  # of the values' precision: loops stay in single precision
    of_blue, of_green, of_red = number(_BLUE), number(_GREEN), number(_RED)
    for i in range(len(grey)):
        brightness = of_blue * blue[i] + of_green * green[i] + of_red * red[i]
        grey[i], bluer[i], redder[i] = brightness, blue[i] - brightness, red[i] - brightness


@compiled
def _from_chroma(grey: Reals, blue: Reals, green: Reals, red: Reals) -> None:
    """Replace blue and red minus luma (k,) by colours, and fill green."""
    number = grey.dtype.type
    blue_share, red_share = number(_BLUE / _GREEN), number(_RED / _GREEN)
    for i in range(len(grey)):
        bluer, redder = blue[i], red[i]
        blue[i], red[i] = grey[i] + bluer, grey[i] + redder
        green[i] = grey[i] - (blue_share * bluer + red_share * redder)


@compiled
def _interpolated(grey: Reals, n: int) -> Reals:
    """Rows of n from the second on, blurred across as interpolation does; the last is repeated."""
    number, out = grey.dtype.type, np.empty(len(grey) - n, grey.dtype)
    side, inner, end = number(_SIDE_WEIGHT), number(1 - 2 * _SIDE_WEIGHT), number(1 - _SIDE_WEIGHT)
    last = len(out) - n
    for i in range(last):
        out[i] = inner * grey[n + i] + side * (grey[i] + grey[2 * n + i])
    for i in range(last, len(out)):
        out[i] = end * grey[n + i] + side * grey[i]
    return out


@compiled
def _blur(values: Reals, n: int, out: Reals) -> None:
    """Blur rows of n across, into the rows from CHROMA_REACH on; all taps in one pass."""
    number = out.dtype.type
    a, b, c, d = number(_TAPS[0]), number(_TAPS[1]), number(_TAPS[2]), number(_TAPS[3])
    v1, v2, v3 = values[n:], values[2 * n :], values[3 * n :]
    v4, v5, v6 = values[4 * n :], values[5 * n :], values[6 * n :]
    for i in range(len(out)):
        inner = a * v3[i] + b * (v2[i] + v4[i])
        out[i] = inner + c * (v1[i] + v5[i]) + d * (values[i] + v6[i])
