"""Columns of a run's tables as arrays."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from measure.arrays import Floats, Ints

Texts: TypeAlias = NDArray[np.str_]


def numbers(table: pa.Table, *names: str) -> Floats:
    """One column as (n,), or several as (n, k); what is missing is NaN."""
    columns = [np.asarray(table[name].to_numpy(), dtype=np.float64) for name in names]
    return columns[0] if len(names) == 1 else np.stack(columns, axis=1)


def integers(table: pa.Table, name: str) -> Ints:
    """A column of whole numbers (n,); what is missing is -1."""
    return np.asarray(pc.fill_null(table[name], -1).to_numpy(), dtype=np.int64)


def texts(table: pa.Table, name: str) -> Texts:
    """A column of words (n,)."""
    return np.array(table[name].to_pylist(), dtype=np.str_)


def matrices(table: pa.Table, name: str, side: int) -> Floats:
    """A column of square matrices (n, side, side); what is missing is NaN."""
    column = pa.chunked_array(table[name]).combine_chunks()
    out = np.full((len(column), side**2), np.nan)
    here = np.asarray(column.is_valid().to_numpy(zero_copy_only=False))
    out[here] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, side**2)
    return out.reshape(-1, side, side)
