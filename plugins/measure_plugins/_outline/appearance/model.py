"""How a camera shows balls: tone curve, blur, surface and lights.

See docs/explanation/outline.md, formula 10.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from measure.arrays import Floats, Singles
from measure.errors import ConfigError
from measure_plugins._outline.appearance import radial_basis
from measure_plugins._outline.appearance.point_lights import no_point_lights
from measure_plugins._outline.appearance.sensor import encoding

GLOSSY, MATT = radial_basis.REFRACTIVE_INDEX, 1.0001
"""Refractive index of lacquer and clear plastic; and of paint without a boundary that reflects."""
BENDS = 3
DEFAULT_CORRECTION_WEIGHT = 0.9
"""Correction weight before it is estimated how well predictions agree with pictures."""
_LEVELS = np.arange(256) / 255.0
_FLATTEST = 1e-4


@dataclass(frozen=True, eq=False)
class Appearance:
    """Parameters of the model that predicts a ball's picture."""

    tone: str  # name of the tone curve to start from, as in `tone_table`
    bends: Floats  # (3,) the camera's deviation from it, see `bent_table`
    blur_px: float  # sigma of the blur of brightness
    index: float
    # whether it mirrors, at grazing angles, the colours of what is behind the ball.
    mirrors: bool = True
    # (k, 4) in the camera frame, see `point_lights`; none if not known.
    point_lights: Floats = field(default_factory=no_point_lights)
    # share of the predicted bias of edges that is subtracted, see `trust`.
    correction_weight: float = DEFAULT_CORRECTION_WEIGHT

    @cached_property
    def table(self) -> Floats:
        """Light (256,) of each picture value."""
        return bent_table(self.tone, self.bends)

    @cached_property
    def encoding(self) -> Singles:
        """How the camera turns light into picture values, see `sensor.encoding`."""
        return encoding(self.table)

    def tables(self, radius_px: float, half_angle: float) -> radial_basis.RadialTables:
        """Profiles of a ball of this size along a ray across its outline."""
        return radial_basis.radial_tables(
            radius_px, half_angle, self.blur_px, self.index, self.mirrors
        )


def first_appearance(tone: str) -> Appearance:
    """Assumed before the first estimate: the stated curve, a webcam's blur, glossy balls."""
    return Appearance(tone, np.zeros(BENDS), radial_basis.BLUR_PX, GLOSSY)


def bent_table(tone: str, bends: Floats) -> Floats:
    """A tone table with a lift of the blacks, a bow and an S of its values (formula 10).

    The response curves of real cameras lie near a space of few dimensions (Grossberg and Nayar
    2003).

    Args:
        bends: (3,) lift of the blacks, bow, S; shares of the largest value.

    Returns:
        (256,) light, rising, 0 to 1.
    """
    lift, bow, s_shape = bends
    values = _LEVELS - lift * (1 - _LEVELS)
    values = values + bow * np.sin(np.pi * _LEVELS) + s_shape * np.sin(2 * np.pi * _LEVELS)
    values = np.maximum.accumulate(np.clip(values, 0, None)) + _FLATTEST * _LEVELS
    return np.interp(values / values[-1], _LEVELS, tone_table(tone))


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
