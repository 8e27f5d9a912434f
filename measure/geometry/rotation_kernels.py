"""Rotations in compiled code: the exponential and the logarithm of SO(3)."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined


@compiled
def skew(v: Floats) -> Floats:
    """The cross-product matrix (3, 3) of a vector (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@compiled
def apply_matrix(matrix: Floats, v: Floats) -> Floats:
    """A matrix (3, 3) times a vector (3,); for so few numbers a library call costs more."""
    out = np.empty(3)
    for i in range(3):
        out[i] = matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2]
    return out


@compiled
def rotation_of(rotvec: Floats) -> Floats:
    """The rotation (3, 3) of a rotation vector (3,) in rad (Rodrigues)."""
    angle = np.sqrt(np.sum(rotvec * rotvec))
    cross = skew(rotvec)
    if angle < 1e-8:
        return np.eye(3) + cross
    a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    return np.eye(3) + a * cross + b * (cross @ cross)


@inlined
def turned(x: float, y: float, z: float, v: Floats) -> tuple[float, float, float]:
    """A vector (3,) turned by a rotation vector x, y, z in rad (Rodrigues)."""
    square = x * x + y * y + z * z
    p, q, r = y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]
    if square < 1e-16:
        return v[0] + p, v[1] + q, v[2] + r
    angle = np.sqrt(square)
    a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / square
    return (
        v[0] + a * p + b * (y * r - z * q),
        v[1] + a * q + b * (z * p - x * r),
        v[2] + a * r + b * (x * q - y * p),
    )


@compiled
def rotvec_of(rotation: Floats) -> Floats:
    """The rotation vector (3,) of a rotation (3, 3) by well under half a turn."""
    axis = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = np.sqrt(np.sum(axis * axis))
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1)
    return axis * (np.arctan2(sine, cosine) / sine) if sine > 1e-12 else axis
