"""Uncertainty that travels: propagation, and rigid transforms that carry a 6x6 covariance.

Normal equations may be singular: what they do not determine stays put.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaincinv

from measure.arrays import Floats, floats
from measure.geometry.transform import RigidTransform, chart_jacobian, skew

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


def undetermined(covariance: Floats, largest_sd: Floats) -> Floats:
    """Directions (n, k) of the parameters that a covariance (n, n) leaves open.

    They are those whose standard deviation is larger than `largest_sd` (n,), from which on a
    parameter counts as not known; each is as long as it is then, the least determined one first.
    """
    values, axes = np.linalg.eigh(covariance / (largest_sd[:, None] * largest_sd))
    return np.asarray(axes[:, values > 1.0][:, ::-1] * largest_sd[:, None])


def _unit_scale(matrix: Floats) -> Floats:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return np.asarray(1 / np.where(size > 0, size, 1.0))


MAD_TO_SD = 1.4826
"""A normal variable's standard deviation over the median of its absolute values."""
TUKEY_SIGMAS = 4.685
"""Standard deviations beyond which Tukey's weights are zero, for 95 % efficiency with normal errors
(Huber and Ronchetti 2009, section 4.8)."""


def propagate(jacobian: Floats, covariance: Floats) -> Floats:
    """First-order propagation `J C J^T`, (..., m, n) and (..., n, n) to (..., m, m)."""
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def squared_mahalanobis(residuals: Floats, covariances: Floats) -> Floats:
    """Squared Mahalanobis distances (...) of residuals (..., n) under covariances (..., n, n)."""
    solved = np.linalg.solve(covariances, residuals[..., None])[..., 0]
    return np.einsum("...i,...i->...", residuals, solved)


@lru_cache(maxsize=256)
def chi_square_quantile(probability: float, degrees: int) -> float:
    """The value that a chi-square variable of `degrees` of freedom stays below with `probability`.

    Example:
        >>> round(chi_square_quantile(0.95, 2), 3)
        5.991
    """
    return float(2 * gammaincinv(degrees / 2, probability))


def inverted(transform: RigidTransform, covariance: Floats) -> tuple[RigidTransform, Floats]:
    """source_from_target (...) and its covariances (..., 6, 6) to first order."""
    back = transform.inverse()
    # t' = -R^T t and R' = R^T; R -> exp(w) R gives dw' = -R^T w, dt' = -R^T (dt + t x w).
    jacobian = np.zeros((*back.translation.shape[:-1], 6, 6))
    jacobian[..., :3, :3] = jacobian[..., 3:, 3:] = -back.rotation
    jacobian[..., :3, 3:] = -back.rotation @ skew(transform.translation)
    return back, propagate(jacobian, covariance)


@dataclass(frozen=True, eq=False)
class UncertainTransform:
    """A rigid transform with the covariance of its `perturb` chart."""

    transform: RigidTransform  # target_from_source, a single one
    covariance: Floats  # (6, 6), order x y z (mm), rotation vector (rad), both in the target frame

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", floats("covariance", self.covariance, 6, 6))

    def inverse(self) -> UncertainTransform:
        """source_from_target with its covariance to first order."""
        return UncertainTransform(*inverted(self.transform, self.covariance))

    def __matmul__(self, other: UncertainTransform) -> UncertainTransform:
        """Composition of two independent uncertain transforms."""
        rotation = self.transform.rotation
        left = np.eye(6)
        left[:3, 3:] = -skew(rotation @ other.transform.translation)
        right = np.zeros((6, 6))
        right[:3, :3] = right[3:, 3:] = rotation
        covariance = propagate(left, self.covariance) + propagate(right, other.covariance)
        return UncertainTransform(self.transform @ other.transform, covariance)

    def point_covariance(self, point: Floats) -> Floats:
        """Covariance (3, 3) in mm^2 of where an exact source point (3,) lands."""
        return propagate(chart_jacobian(self.transform.rotate(point)), self.covariance)
