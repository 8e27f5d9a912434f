"""OpenCV's fisheye lens, with its Jacobians, and its inverse: what `distortion.py` is to a pinhole.

A ray at the angle t off the optical axis is imaged at the distance t (1 + k1 t^2 + k2 t^4 + k3 t^6
+ k4 t^8) from it: equidistant, bent by four terms (Kannala and Brandt 2006; OpenCV calib3d,
"Fisheye camera model"). Points are given in normalised image coordinates (X/Z, Y/Z) as for a
pinhole: rays across the axis, which lie at infinity, and those behind them have no image.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats

_WIDEST_RAD = np.deg2rad(89.0)
_TINY = 1e-20
_STEPS = 60
_TOLERANCE = 1e-12


def distort_with_jacobians(points: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    """Distort normalised points.

    Args:
        points: (n, 2) ideal normalised coordinates.
        coefficients: (8,) k1 k2 k3 k4 and four zeros.

    Returns:
        Distorted points (n, 2), their Jacobian by the points (n, 2, 2), and by the coefficients
        (n, 2, 8).
    """
    out, by_point = distort(points, coefficients)
    r, angle = _polar(points)
    by_coefficient = np.zeros((len(points), 2, 8))
    for k in range(4):
        by_coefficient[:, :, k] = points * (angle ** (2 * k + 3) / r)[:, None]
    return out, by_point, by_coefficient


def distort(points: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Distorted points (n, 2) and their Jacobian (n, 2, 2) by the points."""
    r, angle = _polar(points)
    bent, slope = _bent(angle, coefficients)
    scale = bent / r
    rise = (slope / (1 + r * r) - scale) / (r * r)
    by_point = rise[:, None, None] * points[:, :, None] * points[:, None, :]
    by_point[:, 0, 0] += scale
    by_point[:, 1, 1] += scale
    return points * scale[:, None], by_point


def fold_radius(coefficients: Floats) -> float:
    """The ideal radius up to which the model holds: it does not fold, and the ray is in front."""
    k1, k2, k3, k4 = coefficients[:4]
    # Roots of the derivative in 1 / angle^2, in which it stays tame if coefficients vanish.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.tan(min(_WIDEST_RAD, 1 / np.sqrt(real.max(initial=1e-9)))))


def undistort(points: Floats, coefficients: Floats, reach: float) -> Floats:
    """Invert `distort` by Newton's method within bounds, which always converges.

    Args:
        points: (n, 2) distorted normalised coordinates.
        coefficients: (8,).
        reach: the ideal radius up to which there is an inverse, `fold_radius(coefficients)`.

    Returns:
        (n, 2) ideal coordinates; NaN where the model has no inverse.
    """
    bent = np.sqrt(np.maximum(np.sum(points**2, axis=1), _TINY))
    low, high = np.zeros(len(bent)), np.full(len(bent), np.arctan(reach))
    seen = bent < _bent(high, coefficients)[0]
    angle = np.minimum(bent, high)
    for _ in range(_STEPS):
        reached, slope = _bent(angle, coefficients)
        off = reached - bent
        low, high = np.where(off > 0, low, angle), np.where(off > 0, angle, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            closer = angle - off / slope
        closer = np.where((low <= closer) & (closer <= high), closer, (low + high) / 2)
        step, angle = np.abs(closer - angle), closer
        if not np.any(step[seen] > _TOLERANCE):
            break
    scale: Floats = np.where(seen, np.tan(angle) / bent, np.nan)
    return points * scale[:, None]


def _polar(points: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) of ideal points from the axis, never quite 0, and angles (n,) of rays."""
    r: Floats = np.sqrt(np.maximum(np.sum(points**2, axis=1), _TINY))
    return r, np.arctan(r)


def _bent(angle: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Imaged angles (n,) and their derivatives (n,) by the angles."""
    t = angle * angle
    k1, k2, k3, k4 = coefficients[:4]
    imaged = angle * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    return imaged, 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
