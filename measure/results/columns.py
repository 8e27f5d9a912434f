"""Columns of a run's tables as arrays."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from measure.arrays import Floats, Ints

Texts: TypeAlias = NDArray[np.str_]


def numbers(table: pa.Table, *names: str) -> Floats:
    """One column as (n,), or several as (n, k); what is missing is NaN."""
    columns = [
        np.array([np.nan if v is None else v for v in table[name].to_pylist()], dtype=np.float64)
        for name in names
    ]
    return columns[0] if len(names) == 1 else np.stack(columns, axis=1)


def integers(table: pa.Table, name: str) -> Ints:
    """A column of whole numbers (n,); what is missing is -1."""
    return np.array([-1 if v is None else v for v in table[name].to_pylist()], dtype=np.int64)


def texts(table: pa.Table, name: str) -> Texts:
    """A column of words (n,)."""
    return np.array(table[name].to_pylist(), dtype=np.str_)


def matrices(table: pa.Table, name: str, side: int) -> Floats:
    """A column of square matrices (n, side, side); what is missing is NaN."""
    missing = [np.nan] * side**2
    rows = [missing if value is None else value for value in table[name].to_pylist()]
    return np.array(rows, dtype=np.float64).reshape(-1, side, side)
