"""Tone curves: from an 8-bit picture value to light, 0 to 1, as a table of 256 entries.

The curve is undone on the pixel values *before* any interpolation: a tone curve moves a one-pixel
edge by an amount that depends on its contrast, and interpolating first leaves half of that.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.errors import ConfigError

_LEVELS = np.arange(256) / 255.0


def srgb_to_light(value: Floats) -> Floats:
    """The sRGB transfer function (IEC 61966-2-1), values and light 0 to 1."""
    bent = ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(value <= 0.04045, value / 12.92, bent)


def tone_table(tone: str) -> Floats:
    """The table (256,) of a tone curve.

    Args:
        tone: "srgb", "none" (values are taken as they are), or "gamma" with its exponent, like
            "gamma2.2".

    Raises:
        ConfigError: the curve is not one of these.
    """
    if tone == "srgb":
        return srgb_to_light(_LEVELS)
    if tone == "none":
        return _LEVELS.copy()
    try:
        exponent = float(tone.removeprefix("gamma"))
    except ValueError:
        exponent = 0.0
    if not tone.startswith("gamma") or not 0.3 <= exponent <= 5.0:
        raise ConfigError(
            f"tone '{tone}' is not known: use srgb, none, or gamma with its exponent, like gamma2.2"
        )
    return np.asarray(_LEVELS**exponent)
