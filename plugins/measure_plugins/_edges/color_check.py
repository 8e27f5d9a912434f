"""Whether what lies inside an outline has the ball's colour."""

from __future__ import annotations

from measure.arrays import Bytes, Floats
from measure.compiling import compiled

_RINGS = (0.25, 0.5, 0.7, 0.85)
"""Radii, as shares of the outline's, where the colour is looked at."""
_LEVELS = 256


@compiled
def color_share(pixels: Bytes, colors: Bytes, bit: int, center: Floats, points: Floats) -> float:
    """Share of the samples between the centre and edge points that have a colour.

    Args:
        pixels: (h, w, 3) uint8.
        colors: (k, k, k) bits by blue, green and red, each cut to as many levels, a
            power of two.
        bit: the colour's.
        center: (2,) px.
        points: (n, 2) px.
    """
    height, width = pixels.shape[:2]
    seen, alike, cut = 0, 0, 0
    while len(colors) << cut < _LEVELS:
        cut += 1
    for i in range(len(points)):
        for share in _RINGS:
            x = round(center[0] + share * (points[i, 0] - center[0]))
            y = round(center[1] + share * (points[i, 1] - center[1]))
            if 0 <= x < width and 0 <= y < height:
                b, g, r = pixels[y, x]
                seen += 1
                alike += colors[b >> cut, g >> cut, r >> cut] & bit != 0
    return alike / seen if seen else 0.0
