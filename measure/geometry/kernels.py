"""Small symmetric systems and rotations, without leaving compiled code."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined


@compiled
def cholesky(matrix: Floats, out: Floats) -> bool:
    """The lower factor of a symmetric positive matrix (k, k) into `out`; False if it is not one."""
    k = len(matrix)
    for a in range(k):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= out[a, c] * out[b, c]
            if a > b:
                out[a, b] = total / out[b, b]
            elif total > 0:
                out[a, a] = np.sqrt(total)
            else:
                return False
    return True


@compiled
def solve_factored(factor: Floats, right: Floats, out: Floats) -> None:
    """Solve with the lower factor (k, k) of `cholesky` for a right side (k,), into `out` (k,)."""
    k = len(right)
    for a in range(k):
        total = right[a]
        for b in range(a):
            total -= factor[a, b] * out[b]
        out[a] = total / factor[a, a]
    for a in range(k - 1, -1, -1):
        total = out[a]
        for b in range(a + 1, k):
            total -= factor[b, a] * out[b]
        out[a] = total / factor[a, a]


@compiled
def invert_factored(factor: Floats, out: Floats) -> None:
    """The inverse (k, k) of the matrix whose lower factor `cholesky` found, into `out`."""
    k = len(factor)
    half = np.zeros((k, k))  # the factor's own inverse
    for a in range(k):
        half[a, a] = 1 / factor[a, a]
        for c in range(a):
            for b in range(c + 1):
                half[a, b] -= factor[a, c] * half[c, b]
        for b in range(a):
            half[a, b] *= half[a, a]
    for a in range(k):
        for b in range(a + 1):
            total = 0.0
            for c in range(a, k):
                total += half[c, a] * half[c, b]
            out[a, b] = out[b, a] = total


@compiled
def invert_scaled(matrix: Floats, out: Floats) -> float:
    """Fill the inverse (k, k) of a normal matrix whose unknowns have units of their own.

    Args:
        matrix: (k, k); its lower half counts; changed.
        out: (k, k) filled; zero if the equations leave an unknown open.

    Returns:
        By how much the other unknowns inflate the variance of the one that they inflate most;
        infinite if the equations leave one open.
    """
    k = len(matrix)
    size, factor, inflation = np.empty(k), np.empty((k, k)), 0.0
    out[:] = 0.0
    for a in range(k):
        size[a] = np.sqrt(matrix[a, a])
        if not 0 < size[a] < np.inf:
            return np.inf
        for b in range(a + 1):
            matrix[a, b] /= size[a] * size[b]
    if not cholesky(matrix, factor):
        return np.inf
    invert_factored(factor, out)
    for a in range(k):
        inflation = max(inflation, out[a, a])
        for b in range(k):
            out[a, b] /= size[a] * size[b]
    return inflation


@compiled
def inverse(matrix: Floats) -> Floats:
    """The inverse of a symmetric positive matrix (k, k), not a number if it is none."""
    factor, out = np.empty(matrix.shape), np.full(matrix.shape, np.nan)
    if cholesky(matrix, factor):
        invert_factored(factor, out)
    return out


@compiled
def solved(matrix: Floats, right: Floats) -> Floats:
    """What a symmetric positive matrix (k, k) takes to `right` (k,), not a number if it is none."""
    factor, out = np.empty(matrix.shape), np.full(right.shape, np.nan)
    if cholesky(matrix, factor):
        solve_factored(factor, right, out)
    return out


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
