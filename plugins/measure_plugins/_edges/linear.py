"""Small symmetric systems, solved without leaving compiled code."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled


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
