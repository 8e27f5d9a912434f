"""The tables of a run folder, as far as they belong together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.errors import RunError
from measure.results.journal import MEND, read_table
from measure.results.tables import SCHEMAS

PLACE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""The columns of a pose."""
_UNIT = 1e-3
"""By how much a quaternion's length may differ from one."""


def read_tables(folder: Path) -> dict[str, pa.Table]:
    """The rows of all frame sets whose pose was written; a kill may leave some of one more.

    Raises:
        RunError: a table is missing or cannot be read, or holds no poses such as a run writes.
    """
    tables = {name: read_table(folder, name, schema) for name, schema in SCHEMAS.items()}
    if wrong := _what_is_wrong(tables["poses"]):
        raise RunError(f"{folder}: the poses are damaged: {wrong}: {MEND}")
    complete = tables["poses"].num_rows
    return {name: t.filter(pc.less(t["index"], complete)) for name, t in tables.items()}


def _what_is_wrong(poses: pa.Table) -> str:
    if not np.array_equal(poses["index"].to_numpy(), np.arange(len(poses))):
        return "frame sets are missing or out of order"
    place = np.stack([poses[name].to_numpy() for name in ("time_s", *PLACE)], axis=1)
    there = np.isfinite(place[:, 1])
    bad = ~np.isfinite(place[:, 0]) | (there & ~np.isfinite(place).all(axis=1))
    length = np.linalg.norm(np.where(bad[:, None], 1.0, place)[there, 4:], axis=1)
    bad[there] |= np.abs(length - 1) > _UNIT
    if bad.any():
        return f"frame set {int(np.argmax(bad))} has no time, or half a pose"
    covariances = poses["covariance"].filter(pa.array(there))
    if covariances.null_count or pc.any(pc.is_null(pc.list_flatten(covariances))).as_py():
        return "a pose has no covariance"
    return ""
