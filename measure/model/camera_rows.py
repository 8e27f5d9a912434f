"""Where lens models hold, and cameras as the arrays that compiled code takes."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from measure.arrays import Floats

Projection = Literal["pinhole", "fisheye"]
"""Lens models: a pinhole with distortion, or an equidistant fisheye, both as OpenCV has them."""
MIN_DEPTH_MM = 1e-6
"""Points nearer to the camera's plane than this, or behind it, have no image."""
_WIDEST_RAD = np.deg2rad(89.0)


class RigRows(NamedTuple):
    """The arrays of n cameras as compiled code takes them."""

    lenses: Floats  # (n, 16) see `Intrinsics.row`
    reach: Floats  # (n,) ideal radii beyond which the lens models see nothing
    rotation: Floats  # (n, 3, 3) of world_from_camera
    centers: Floats  # (n, 3) projection centres in the world, mm
    covariances: Floats  # (n, 18, 18) of pose and intrinsics (see `Camera`); zero where unknown


def check_coefficients(distortion: Sequence[float] | Floats, model: Projection) -> None:
    """Refuse distortion coefficients that a lens model does not have.

    Raises:
        ValueError: with their number.
    """
    given = len(distortion)
    if given not in (0, 4, 5, 8):
        raise ValueError(f"distortion: expected 0, 4, 5 or 8 coefficients, got {given}")
    if model == "fisheye" and np.any(distortion[4:]):
        raise ValueError(f"distortion of a fisheye: expected 0 or 4 coefficients, got {given}")


def pinhole_fold(coefficients: Floats) -> float:
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
    largest = max(_largest_root(polynomial) for polynomial in (slope, below))
    return float(1 / np.sqrt(largest)) if largest else float("inf")


def fisheye_fold(coefficients: Floats) -> float:
    """The ideal radius up to which the model holds: it does not fold, and the ray is in front."""
    k1, k2, k3, k4 = coefficients[:4]
    # The derivative's roots in 1 / angle^2, in which it stays tame if coefficients vanish.
    largest = _largest_root(np.array([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
    return float(np.tan(min(_WIDEST_RAD, 1 / np.sqrt(max(largest, 1e-9)))))


def _largest_root(polynomial: Floats) -> float:
    """Its largest positive root, highest power first; 0 without one."""
    roots = np.roots(polynomial)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.max(initial=0.0))
