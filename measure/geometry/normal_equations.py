"""Normal equations that may be singular: what they do not determine stays put."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats

UNDETERMINED = 1e-12
"""Eigenvalues of a normal matrix this small, as a share of the largest, are rounding."""
_ROUNDING = 1e-15


def symmetric_inverse(matrix: Floats) -> Floats:
    """The inverse (n, n) of a symmetric matrix; directions it does not determine stay put.

    Of any units, as all parameters are scaled alike.
    """
    scale = _unit_scale(matrix)
    scaled = matrix * scale[:, None] * scale
    inverse = np.linalg.pinv(scaled, rcond=UNDETERMINED, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)


def posterior_covariance(matrix: Floats, precision: Floats) -> Floats:
    """The inverse (n, n) of `matrix + diag(precision)`: what data and a prior say together.

    Args:
        matrix: (n, n) normal matrix of the data; it may be singular where `precision` is not 0.
        precision: (n,) inverse variances of what is known beforehand; 0 where all is open.
    """
    scale = np.where(precision > 0, 1 / np.sqrt(np.where(precision > 0, precision, 1.0)), 0.0)
    scale = np.where(scale > 0, scale, _unit_scale(matrix))
    scaled = (matrix + np.diag(precision)) * scale[:, None] * scale
    if (precision > 0).all():  # no eigenvalue is below 1 then
        inverse = np.linalg.inv(scaled)
    else:
        inverse = np.linalg.pinv(scaled, rcond=_ROUNDING, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)


def undetermined(matrix: Floats, largest_sd: Floats) -> Floats:
    """Directions (n, k) of the parameters that a normal matrix (n, n) does not determine.

    They are those whose standard deviation would be larger than `largest_sd` (n,), from which on a
    parameter counts as not known; each is as long as it is then, the least determined one first.
    """
    values, axes = np.linalg.eigh(matrix * largest_sd[:, None] * largest_sd)
    return np.asarray(axes[:, values < 1.0] * largest_sd[:, None])


def _unit_scale(matrix: Floats) -> Floats:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return np.asarray(1 / np.where(size > 0, size, 1.0))
