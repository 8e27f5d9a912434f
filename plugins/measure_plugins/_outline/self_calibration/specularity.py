"""Strength of the highlights of point lights, which glossy balls show and matt ones do not.

Light from a dielectric is its body colour times one amount plus the lights' colour times another
(Shafer 1985, the dichromatic reflection model). On a coloured ball the two are separable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Bools, Bytes, Floats

_INNER_RADIUS = 0.93
"""Share of the outline's radius: pixels further out are blurred with the background."""
_MIN_PIXELS = 50
_HIGHLIGHT_QUANTILE = 0.995
"""Surface reflection above this quantile is a highlight: noise alone exceeds it on fewer pixels."""
_LIT_QUANTILE = 0.9  # Quantile of body reflection used as that of the lit side
_MIN_SATURATION = 0.3
"""Least difference of the strongest and the weakest channel of a body colour, of maximum 1."""


def highlights(balls: Sequence[tuple[Bytes, Floats, Bools]], table: Floats) -> float:
    """Highlights of the median ball, as a share of the body reflection of its lit side.

    Args:
        balls: of each, the pixels (h, w, 3) of its part of the picture, its outline (n, 2) in px
            of that part, in order, and whether the way is clear along each of these n rays.
        table: (256,) light of each picture value.

    Returns:
        The share; NaN if all balls are white, too small or mostly occluded.
    """
    shares = [_share(table[_inside(*ball)]) for ball in balls]
    known = [share for share in shares if not np.isnan(share)]
    return float(np.median(known)) if known else float("nan")


def _inside(pixels: Bytes, outline: Floats, clear: Bools) -> Bytes:
    """Pixels (k, 3) inside the outline, along clear rays."""
    center = outline.mean(axis=0)
    radii, angles = _polar(outline - center)
    order = np.argsort(angles)
    v, u = np.indices(pixels.shape[:2]).reshape(2, -1)
    off, angle = _polar(np.stack([u, v], axis=1) - center)
    ray = order[np.searchsorted(angles[order], angle) % len(order)]
    return np.asarray(pixels.reshape(-1, 3)[(off < _INNER_RADIUS * radii[ray]) & clear[ray]])


def _polar(points: Floats) -> tuple[Floats, Floats]:
    """Radii and angles (n,) of points (n, 2)."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _share(light: Floats) -> float:
    """The same of light (k, 3) from one ball; NaN if it is too small or white."""
    if len(light) < _MIN_PIXELS:
        return float("nan")
    own = np.median(light, axis=0)
    own = own / max(float(own.max()), 1e-9)
    strong, weak = int(np.argmax(own)), int(np.argmin(own))
    if own[strong] - own[weak] < _MIN_SATURATION:
        return float("nan")
    amount = (light[:, strong] - light[:, weak]) / (own[strong] - own[weak])
    grey = light[:, weak] - amount * own[weak]
    brightest, typical = np.quantile(grey, [_HIGHLIGHT_QUANTILE, 0.5])
    return float((brightest - typical) / max(float(np.quantile(amount, _LIT_QUANTILE)), 1e-9))
