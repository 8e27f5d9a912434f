"""Highlights: what lamps leave on glossy balls and never on matt ones.

Light from a dielectric is its own colour times one amount, and the lamps' colour times another
(Shafer 1985, the dichromatic reflection model). On a coloured ball the two can be told apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Bools, Bytes, Floats

_WITHIN = 0.93
"""Share of the outline's radius: further out, what is behind the ball is blurred in."""
_FEWEST_PIXELS = 50
_BRIGHTEST = 0.995
"""Quantile of colourless light that counts as a highlight's: noise has brighter pixels, fewer."""
_BRIGHT = 0.9
"""Quantile of the ball's own light that counts as lit."""
_COLORED = 0.3
"""A ball whose own colour's weakest channel is this much below its strongest tells highlights."""


def highlights(balls: Sequence[tuple[Bytes, Floats, Bools]], table: Floats) -> float:
    """How strong the highlights on the median ball are, as a share of its lit side's own light.

    Args:
        balls: of each, the pixels (h, w, 3) of its part of the picture, its outline (n, 2) in px
            of that part, in order, and whether the way is clear along each of these n rays.
        table: (256,) light of each picture value.

    Returns:
        The share; NaN if no ball tells: white ones, and those too small or mostly hidden.
    """
    shares = [_share(table[_inside(*ball)]) for ball in balls]
    told = [share for share in shares if not np.isnan(share)]
    return float(np.median(told)) if told else float("nan")


def _inside(pixels: Bytes, outline: Floats, clear: Bools) -> Bytes:
    """Pixels (k, 3) inside the outline, along clear rays."""
    center = outline.mean(axis=0)
    radii, angles = _polar(outline - center)
    order = np.argsort(angles)
    v, u = np.indices(pixels.shape[:2]).reshape(2, -1)
    off, angle = _polar(np.stack([u, v], axis=1) - center)
    ray = order[np.searchsorted(angles[order], angle) % len(order)]
    return np.asarray(pixels.reshape(-1, 3)[(off < _WITHIN * radii[ray]) & clear[ray]])


def _polar(points: Floats) -> tuple[Floats, Floats]:
    """Radii and angles (n,) of points (n, 2)."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _share(light: Floats) -> float:
    """The strength of the highlights in light (k, 3) from one ball; NaN if it does not tell."""
    if len(light) < _FEWEST_PIXELS:
        return float("nan")
    own = np.median(light, axis=0)
    own = own / max(float(own.max()), 1e-9)
    strong, weak = int(np.argmax(own)), int(np.argmin(own))
    if own[strong] - own[weak] < _COLORED:
        return float("nan")
    amount = (light[:, strong] - light[:, weak]) / (own[strong] - own[weak])
    grey = light[:, weak] - amount * own[weak]
    brightest, typical = np.quantile(grey, [_BRIGHTEST, 0.5])
    return float((brightest - typical) / max(float(np.quantile(amount, _BRIGHT)), 1e-9))
