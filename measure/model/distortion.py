"""OpenCV's rational radial + tangential lens distortion, with its Jacobians, and its inverse.

Normalised image coordinates x = (X/Z, Y/Z); coefficients in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6
(Brown 1966; OpenCV calib3d, "Detailed description"). Beyond some radius the polynomial folds the
plane back over the image: points there have no image, and nothing was calibrated there.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-12


def distort_with_jacobians(points: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    """Distort normalised points.

    Args:
        points: (n, 2) ideal normalised coordinates.
        coefficients: (8,) k1 k2 p1 p2 k3 k4 k5 k6, or (8, n) to give each point its own.

    Returns:
        Distorted points (n, 2), their Jacobian by the points (n, 2, 2), and by the coefficients
        (n, 2, 8).
    """
    out, by_point = distort(points, coefficients)
    k4, k5, k6 = coefficients[5:]
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    r4, r6 = r2 * r2, r2 * r2 * r2
    below = 1 + k4 * r2 + k5 * r4 + k6 * r6
    radial = (1 + coefficients[0] * r2 + coefficients[1] * r4 + coefficients[4] * r6) / below
    by_coefficient = np.empty((len(x), 2, 8))
    for column, factor in zip(
        (0, 1, 4, 5, 6, 7), (r2, r4, r6, -radial * r2, -radial * r4, -radial * r6), strict=True
    ):
        by_coefficient[:, :, column] = points * (factor / below)[:, None]
    by_coefficient[:, 0, 2], by_coefficient[:, 1, 2] = 2 * x * y, r2 + 2 * y * y
    by_coefficient[:, 0, 3], by_coefficient[:, 1, 3] = r2 + 2 * x * x, 2 * x * y
    return out, by_point, by_coefficient


def distort(points: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """Distorted points (n, 2) and their Jacobian (n, 2, 2) by the points."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    slope = (
        (k1 + r2 * (2 * k2 + 3 * k3 * r2)) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))
    ) / below
    cross = 2 * x * y
    out = np.empty((len(x), 2))
    out[:, 0] = x * radial + p1 * cross + p2 * (r2 + 2 * x * x)
    out[:, 1] = y * radial + p1 * (r2 + 2 * y * y) + p2 * cross
    by_point = np.empty((len(x), 2, 2))
    by_point[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_point[:, 0, 1] = by_point[:, 1, 0] = cross * slope + 2 * p1 * x + 2 * p2 * y
    by_point[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out, by_point


def fold_radius(coefficients: Floats) -> float:
    """The ideal radius up to which the radial distortion grows; infinite if it always does.

    With s = r^2 the distorted radius is r A(s) / B(s); it turns back where its derivative's
    numerator A B + 2 s (A' B - A B') or the denominator B vanishes.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    above, below = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    rising, falling = (np.arange(1.0, 4.0) * p[1:] for p in (above, below))
    slope = np.convolve(above, below)
    slope[1:] += 2 * (np.convolve(rising, below) - np.convolve(above, falling))
    # Both are 1 at s = 0. In t = 1 / s they start with 1 and stay tame if coefficients vanish.
    roots = np.concatenate([np.roots(p) for p in (slope, below)])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / np.sqrt(real.max())) if real.size else float("inf")


def undistort(points: Floats, coefficients: Floats, reach: float | Floats = np.inf) -> Floats:
    """Invert `distort` by Newton's method.

    Args:
        points: (n, 2) distorted normalised coordinates.
        coefficients: (8,), or (8, n) for a lens of its own for each point.
        reach: the ideal radius up to which there is an inverse, `fold_radius(coefficients)`.

    Returns:
        (n, 2) ideal coordinates; NaN where the model has no inverse (far outside the calibrated
        image).
    """
    if not np.any(coefficients):
        return points.copy()
    ideal = points.copy()
    step = np.full_like(points, np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            forward, slope = distort(ideal, coefficients)
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            error = points - forward
            step = np.stack(
                [
                    slope[:, 1, 1] * error[:, 0] - slope[:, 0, 1] * error[:, 1],
                    slope[:, 0, 0] * error[:, 1] - slope[:, 1, 0] * error[:, 0],
                ],
                axis=1,
            )
            step /= determinant[:, None]
            ideal = ideal + step
            if not np.any(np.abs(step) > _NEWTON_TOLERANCE):
                break
        beyond = ~(np.sum(ideal**2, axis=1) < reach**2)
        failed = ~(np.max(np.abs(step), axis=1) < 1e-9) | ~(determinant > 0) | beyond
    ideal[failed] = np.nan
    return ideal
