"""One helper that checks array shapes and says expected *and* actual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Reals: TypeAlias = NDArray[np.floating[Any]]
Bools: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]


def floats(name: str, values: ArrayLike, *shape: int | str) -> Floats:
    """Return `values` as float64 after checking the trailing axes against `shape`.

    Args:
        name: what the array is called in the error message.
        *shape: sizes; a string names an axis of any size, and a leading "..." allows batch axes.

    Raises:
        ValueError: no numbers, or another shape; the message gives expected and actual.

    Example:
        >>> floats("points_world", [[1, 2, 3]], "n", 3).shape
        (1, 3)
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None
    wanted = shape[1:] if shape[:1] == ("...",) else shape
    actual = array.shape[array.ndim - len(wanted) :] if shape[:1] == ("...",) else array.shape
    if actual != wanted and (len(actual) != len(wanted) or not _fits(actual, wanted)):
        expected = ", ".join(str(axis) for axis in shape)
        raise ValueError(f"{name}: expected shape ({expected}), got {array.shape}")
    return array


def stacked(rows: Sequence[Floats]) -> Floats:
    """One array of n >= 1 small ones of one shape: `np.stack` in a third of the time."""
    return np.concatenate(rows, dtype=np.float64).reshape(len(rows), *rows[0].shape)


def rms_length(rows: Floats) -> float:
    """Root mean square of the lengths of n >= 1 rows (n, k)."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def _fits(actual: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    return all(
        isinstance(want, str) or want == have for want, have in zip(wanted, actual, strict=True)
    )
