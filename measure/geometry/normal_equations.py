"""Normal equations that may be singular: what they do not determine stays put."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats

UNDETERMINED = 1e-12
"""Eigenvalues of a normal matrix this small, as a share of the largest, are rounding."""


def symmetric_inverse(matrix: Floats) -> Floats:
    """The inverse (n, n) of a symmetric matrix; directions it does not determine stay put.

    Of any units, as all parameters are scaled alike.
    """
    scale = _unit_scale(matrix)
    scaled = matrix * scale[:, None] * scale
    inverse = np.linalg.pinv(scaled, rcond=UNDETERMINED, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)


def _unit_scale(matrix: Floats) -> Floats:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return np.asarray(1 / np.where(size > 0, size, 1.0))
