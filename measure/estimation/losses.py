"""Robust losses: how much a residual counts by its length, in standard deviations.

Huber and Ronchetti (2009), Robust Statistics, sections 4.5 and 4.8; Lange et al. (1989), JASA 84,
881. Compiled loops have the same weights inline, with the same constants.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry.covariance import TUKEY_SIGMAS
from measure.limits import HUBER_SIGMAS, STUDENT_DEGREES

__all__ = [
    "HUBER_SIGMAS", "STUDENT_DEGREES", "TUKEY_SIGMAS", "Huber", "student_weights", "tukey_weights",
]  # fmt: skip


@dataclass(frozen=True)
class Huber:
    """Huber's loss on the length of a whitened residual: squared up to `reach`, then linear."""

    reach: float = np.inf

    def cost(self, lengths: Floats) -> float:
        """Sum of the losses of lengths (n,)."""
        inside = np.minimum(lengths, self.reach)
        return float(np.sum(inside * (2 * lengths - inside)))

    def weights(self, lengths: Floats) -> Floats:
        """Weights (n,) that make squares have the loss's slope."""
        return (
            self.reach / np.maximum(lengths, self.reach) if np.isfinite(self.reach) else lengths**0
        )


def tukey_weights(squares: Floats, reach: float = TUKEY_SIGMAS) -> Floats:
    """Weights (n,) by the squares of lengths (n,); zero for lengths beyond `reach`."""
    return np.asarray(np.maximum(1 - squares / reach**2, 0.0) ** 2, dtype=np.float64)


def student_weights(squares: Floats) -> Floats:
    """Weights (n,) by the squares of lengths (n,) of one number each, for Student's t."""
    return np.asarray((STUDENT_DEGREES + 1) / (STUDENT_DEGREES + squares), dtype=np.float64)
