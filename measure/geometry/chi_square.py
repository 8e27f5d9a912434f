"""How large a squared Mahalanobis distance may be by chance."""

from __future__ import annotations

from functools import lru_cache

from scipy.special import gammaincinv


@lru_cache(maxsize=256)
def chi_square_quantile(probability: float, degrees: int) -> float:
    """The value that a chi-square variable of `degrees` of freedom stays below with `probability`.

    Example:
        >>> round(chi_square_quantile(0.95, 2), 3)
        5.991
    """
    return float(2 * gammaincinv(degrees / 2, probability))
