"""Poses that put one triangle on others, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled


@compiled
def align_triangles(target: Floats, source: Floats) -> tuple[Floats, Floats]:
    """Least-squares poses of a triangle on m others.

    The best rotation of three points turns plane onto plane, and in the plane by the angle that
    brings the corners closest: what singular values tell of any number of points (Umeyama 1991)
    has this closed form for three.

    Args:
        target: (m, 3, 3) corners, one a row, mm.
        source: (3, 3) the corners that are put on them, not on a line.

    Returns:
        Rotations (m, 3, 3) and translations (m, 3) of target_from_source; not a number where
        target corners are on a line.
    """
    rotation, translation = np.empty((len(target), 3, 3)), np.empty((len(target), 3))
    flat, axes, origin = _in_plane(source)
    for k in range(len(target)):
        seen, onto, center = _in_plane(target[k])
        along, across = 0.0, 0.0
        for i in range(3):
            along += seen[i, 0] * flat[i, 0] + seen[i, 1] * flat[i, 1]
            across += seen[i, 1] * flat[i, 0] - seen[i, 0] * flat[i, 1]
        length = np.hypot(along, across)
        c, s = along / length, across / length
        for a in range(3):
            first, second = c * onto[0, a] + s * onto[1, a], c * onto[1, a] - s * onto[0, a]
            translation[k, a] = center[a]
            for b in range(3):
                turn = first * axes[0, b] + second * axes[1, b] + onto[2, a] * axes[2, b]
                rotation[k, a, b] = turn
                translation[k, a] -= turn * origin[b]
    return rotation, translation


@compiled
def _in_plane(corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Corners (3, 2) about their middle (3,) along the first two of axes (3, 3), rows."""
    axes, flat, middle = np.empty((3, 3)), np.zeros((3, 2)), np.empty(3)
    for a in range(3):
        axes[0, a] = corners[1, a] - corners[0, a]
        axes[1, a] = corners[2, a] - corners[0, a]
        middle[a] = (corners[0, a] + corners[1, a] + corners[2, a]) / 3
    _cross(axes[0], axes[1], axes[2])
    _cross(axes[2], axes[0], axes[1])
    for i in range(3):
        x, y, z = axes[i]
        axes[i] /= np.sqrt(x * x + y * y + z * z)
    for i in range(3):
        for a in range(3):
            off = corners[i, a] - middle[a]
            flat[i, 0] += off * axes[0, a]
            flat[i, 1] += off * axes[1, a]
    return flat, axes, middle


@compiled
def _cross(a: Floats, b: Floats, out: Floats) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
