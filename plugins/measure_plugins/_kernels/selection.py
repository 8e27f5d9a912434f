"""Medians and quantiles without sorting everything."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Reals
from measure.compiling import compiled, inlined

NINE = 9
"""Most rows of `median_rows`."""
_THREE, _FOUR = 3, 4
_QUARTERINGS = 12
"""Iterations: the error is at most the greatest value times a quarter to this power."""


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
def nearly_kth(sizes: Floats, k: int) -> float:
    """The k-th smallest (from 0) of sizes (n,), not negative, up to the error of `_QUARTERINGS`.

    By counting the values below thresholds, without branches, which would be mispredicted.
    """
    low, step = 0.0, 0.0
    for size in sizes:
        step = size if size > step else step
    for _ in range(_QUARTERINGS):
        step *= 0.25
        first, second, third = low + step, low + 2 * step, low + 3 * step
        in_first, in_second, in_third = 0, 0, 0
        for i in range(len(sizes)):
            in_first += int(sizes[i] <= first)
            in_second += int(sizes[i] <= second)
            in_third += int(sizes[i] <= third)
        low += step * (int(in_first <= k) + int(in_second <= k) + int(in_third <= k))
    return low + step


@compiled
def median_rows(rows: Reals, count: int) -> Reals:
    """Medians (n,) over the first `count` of rows (9, n); the others are overwritten."""
    n = rows.shape[1]
    out = np.empty(n, rows.dtype)
    if count == _THREE:
        for i in range(n):
            out[i] = _sorted(rows[0, i], rows[1, i], rows[2, i])[1]
        return out
    if count == _FOUR:
        _middle_of_four(rows, out)
        return out
    for j in range(count, NINE):
        rows[j] = np.inf if j % 2 == 0 else -np.inf
    _middle_of_nine(rows, out)
    if count % 2 == 0:
        lower = np.empty(n, rows.dtype)
        rows[NINE - 1] = -np.inf
        _middle_of_nine(rows, lower)
        for i in range(n):
            out[i] = 0.5 * (lower[i] + out[i])
    return out


@compiled
def _middle_of_four(rows: Reals, out: Reals) -> None:
    """Mean (n,) of the middle two of rows (4, n): the greater low and the lesser high of pairs."""
    half = rows.dtype.type(0.5)
    for i in range(len(out)):
        a, b, c, d = rows[0, i], rows[1, i], rows[2, i], rows[3, i]
        low, high = _greater(_less(a, b), _less(c, d)), _less(_greater(a, b), _greater(c, d))
        out[i] = half * (low + high)


@compiled
def _middle_of_nine(rows: Reals, out: Reals) -> None:
    """Middle (n,) of rows (9, n).

    Without branches, so that the loop is vectorised: each triple is sorted, and the middle is that
    of the greatest low, the middle middle and the least high (Paeth 1990).
    """
    for i in range(len(out)):
        low, middle, high = _sorted(rows[0, i], rows[1, i], rows[2, i])
        low2, middle2, high2 = _sorted(rows[3, i], rows[4, i], rows[5, i])
        low3, middle3, high3 = _sorted(rows[6, i], rows[7, i], rows[8, i])
        greatest_low = _greater(_greater(low, low2), low3)
        least_high = _less(_less(high, high2), high3)
        out[i] = _sorted(greatest_low, _sorted(middle, middle2, middle3)[1], least_high)[1]


@compiled
def _sorted(a: float, b: float, c: float) -> tuple[float, float, float]:
    a, b = _less(a, b), _greater(a, b)
    b, c = _less(b, c), _greater(b, c)
    return _less(a, b), _greater(a, b), c


@compiled
def _less(a: float, b: float) -> float:
    return a if a < b else b


@compiled
def _greater(a: float, b: float) -> float:
    return b if a < b else a


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


DOUBLES, SINGLES = 8, 16
"""Numbers in the longest vectors of a processor."""


@inlined
def whole_vectors(count: int, lanes: int) -> int:
    """The least multiple of `lanes` that is no less than `count`."""
    return -(-count // lanes) * lanes
