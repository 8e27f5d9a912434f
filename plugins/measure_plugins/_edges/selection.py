"""Medians and quantiles without sorting everything."""

from __future__ import annotations

from measure.arrays import Floats
from measure.compiling import compiled


@compiled
def kth_smallest(values: Floats, count: int, k: int) -> float:
    """The k-th smallest (from 0) of the first `count` values, which it reorders (Hoare's find)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(values[k])


@compiled
def median_rows(rows: Floats) -> None:
    """Bring the median over the k rows of (k, n), in every column, into row 0; k is a handful.

    Rows are compared whole, so that many columns are sorted at once: bubble sort as far as needed.
    """
    k, n = rows.shape
    half = k // 2
    for place in range(half + 1):
        for j in range(k - 1, place, -1):
            for i in range(n):
                a, b = rows[j - 1, i], rows[j, i]
                rows[j - 1, i] = a if a < b else b
                rows[j, i] = b if a < b else a
    if k % 2 == 1:
        rows[0] = rows[half]
    else:
        for i in range(n):
            rows[0, i] = 0.5 * (rows[half - 1, i] + rows[half, i])


@compiled
def median(values: Floats, count: int) -> float:
    """Median of the first `count` values, which it reorders."""
    half = count // 2
    upper = kth_smallest(values, count, half)
    if count % 2 == 1:
        return upper
    lower = values[0]
    for i in range(half):
        lower = max(lower, values[i])
    return 0.5 * (lower + upper)
