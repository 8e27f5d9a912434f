"""Settings of the detector `outline`, and its fixed proportions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from measure.host import Settings, setting

FEWER_RAYS, MIN_RAYS = 2, 16
"""Divisor of the number of rays across outlines of unknown size, and the least number."""
GIVE_UP_SHARE = 2 / 3
"""Share of the least agreement below which a candidate is given up before it has converged."""


class OutlineConfig(Settings):
    """Settings of the `outline` detector."""

    renamed: ClassVar[Mapping[str, str]] = {"learn": "self_calibrate"}

    rays: int = setting(
        72, "Rays cast across each outline, an even number.", ge=16, le=720, multiple_of=2
    )
    tone: str = setting(
        "srgb", "The cameras' tone curve: srgb, none, or gamma with its exponent (gamma2.2)."
    )
    self_calibrate: bool = setting(
        True,
        "Whether the tone curve, the blur, the gloss of the balls and the lights are estimated "
        "from the images, starting from the tone curve given here.",
    )
    min_contrast: float = setting(
        0.06,
        "Least difference of a ray's inside and outside, as a share of the largest picture value.",
        gt=0,
    )
    min_color_match: float = setting(
        0.25, "Least share of samples inside the border that have the ball's colour.", ge=0, le=1
    )
    min_agreement: float = setting(
        0.45,
        "Least share of the rays that should show an edge whose edges lie on one outline.",
        ge=0,
        le=1,
    )
    min_rays: int = setting(12, "Fewest edge points an outline is fitted to.", ge=6)
    margin_px: float = setting(
        7.0, "Rays nearer than this to a nearer ball's outline are left out.", unit="px", ge=0
    )
